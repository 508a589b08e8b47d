"""Noise wrappers: distribution, saturation, seeds, Gymnasium's own checker."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import support  # noqa: F401, registers the environments
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import FrameStackObservation
from hypothesis import given
from hypothesis import strategies as st

from sb3_sparse.errors import ConfigError
from sb3_sparse.wrappers import ObservationNoise, PixelNoise


class Constant(gym.Env):
    """One observation, for ever."""

    def __init__(self, value, dtype=np.uint8, shape=(64, 64, 1), low=0, high=255):
        self.observation_space = spaces.Box(low, high, shape, dtype)
        self.action_space = spaces.Discrete(2)
        self.value = np.full(shape, value, dtype)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.value.copy(), {}

    def step(self, action):
        return self.value.copy(), 0.0, False, False, {}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "env",
    [
        lambda: PixelNoise(gym.make("TinyImages-v0").unwrapped, sigma=10),
        lambda: ObservationNoise(gym.make("CartPole-v1").unwrapped, sigma=0.5),
        lambda: ObservationNoise(gym.make("Pendulum-v1").unwrapped, 0.5, std=[1, 2, 3]),
    ],
)
def test_gymnasium_finds_nothing_wrong(env):
    check_env(env(), skip_render_check=True)


def test_pixel_noise_is_integer_of_the_right_spread_and_on_reset_frames_too():
    env = PixelNoise(Constant(128), sigma=10)
    first, _ = env.reset(seed=0)
    second = env.step(0)[0]
    for frame in (first, second):
        assert frame.dtype == np.uint8
        noise = frame.astype(int) - 128
        assert abs(noise.mean()) < 0.6  # 64*64 draws: the standard error is 0.16
        assert abs(noise.std() - np.sqrt(10**2 + 1 / 12)) < 0.5  # rounding adds 1/12
    assert (first != second).any()


@pytest.mark.parametrize(("value", "bound"), [(0, 0), (255, 255)])
def test_pixel_noise_saturates_and_never_wraps(value, bound):
    frame, _ = PixelNoise(Constant(value), sigma=30).reset(seed=0)
    at_bound = (frame == bound).mean()
    assert 0.4 < at_bound < 0.6  # half of the noise points outwards
    assert np.abs(frame.astype(int) - value).max() < 150  # five standard deviations


@given(st.integers(0, 255), st.floats(0, 300), st.integers(0, 2**31))
def test_pixels_stay_pixels(value, sigma, seed):
    frame, _ = PixelNoise(Constant(value, shape=(4, 4, 1)), sigma).reset(seed=seed)
    assert frame.dtype == np.uint8
    assert frame.shape == (4, 4, 1)


def test_sigma_may_be_numpys():
    assert PixelNoise(Constant(7), np.float32(0.5)).sigma == 0.5


def test_no_sigma_no_noise():
    assert (PixelNoise(Constant(7), 0).reset(seed=0)[0] == 7).all()
    env = ObservationNoise(gym.make("CartPole-v1"), 0.0)
    clean = gym.make("CartPole-v1")
    assert (env.reset(seed=3)[0] == clean.reset(seed=3)[0]).all()


def test_below_a_frame_stack_each_frame_keeps_its_noise():
    env = FrameStackObservation(PixelNoise(Constant(100), 20), 3)
    env.reset(seed=0)
    first = env.step(0)[0]
    second = env.step(0)[0]
    assert (first[1:] == second[:-1]).all()
    assert (first[-1] != second[-1]).any()


def test_the_environments_own_randomness_is_untouched():
    noisy, clean = ObservationNoise(gym.make("CartPole-v1"), 0.1), gym.make("CartPole-v1")
    noisy.reset(seed=5)
    clean.reset(seed=5)
    for _ in range(3):
        assert (noisy.unwrapped.state == np.asarray(clean.unwrapped.state)).all()
        noisy.step(1)
        clean.step(1)


def test_the_same_seed_gives_the_same_noise_also_the_second_time():
    env = ObservationNoise(gym.make("CartPole-v1"), 0.5)

    def look():
        return np.array([env.reset(seed=9)[0], *(env.step(i % 2)[0] for i in range(8))])

    assert (look() == look()).all()


def test_vector_noise_is_in_units_of_each_feature():
    env = ObservationNoise(
        Constant(0, np.float32, (2,), -np.inf, np.inf), sigma=2.0, std=[1.0, 10.0]
    )
    env.reset(seed=0)
    noise = np.array([env.step(0)[0] for _ in range(4000)])
    assert noise.dtype == np.float32
    assert np.allclose(noise.std(axis=0), [2.0, 20.0], rtol=0.06)
    assert abs(np.corrcoef(noise.T)[0, 1]) < 0.06


def test_without_a_std_it_is_that_of_the_clean_observations():
    env = ObservationNoise(gym.make("CartPole-v1"), 0.3)
    clean = gym.make("CartPole-v1")
    seen = [clean.reset(seed=2)[0]]
    first, _ = env.reset(seed=2)
    assert (first == seen[0]).all()
    for i in range(8):
        env.step(i % 2)
        seen.append(clean.step(i % 2)[0])
    assert np.allclose(env.std, np.std(seen, axis=0), atol=1e-9)


def test_vectors_stay_within_their_bounds():
    env = ObservationNoise(Constant(0.9, np.float32, (100,), -1, 1), 1.0, std=[1.0] * 100)
    noisy, _ = env.reset(seed=0)
    assert env.observation_space.contains(noisy)
    assert (noisy == 1).sum() > 20


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (lambda: PixelNoise(gym.make("CartPole-v1"), 1), "vectors take ObservationNoise"),
        (lambda: ObservationNoise(gym.make("TinyImages-v0"), 1), "images take PixelNoise"),
        (
            lambda: ObservationNoise(gym.make("TinyDicts-v0"), 1),
            "takes vectors of floats, got Dict",
        ),
        (lambda: PixelNoise(Constant(1), -1), "sigma must be a number, 0 or more, got -1"),
        (lambda: PixelNoise(Constant(1), float("nan")), "sigma must be"),
        (lambda: PixelNoise(Constant(1), "3"), "sigma must be"),
        (lambda: ObservationNoise(gym.make("CartPole-v1"), 1, std=[1]), r"std must be \(4,\)"),
        (lambda: ObservationNoise(gym.make("CartPole-v1"), 1, std=[1, 1, 1, -1]), "0 or more"),
    ],
)
def test_what_does_not_fit_is_refused(wrap, message):
    with pytest.raises(ConfigError, match=message):
        wrap()
