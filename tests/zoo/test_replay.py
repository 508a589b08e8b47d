"""Replay buffers come back from disk as they were, however they were filled and saved."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import DQN, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv

import sb3_sparse.zoo.replay as replay
from sb3_sparse.errors import ConfigError
from sb3_sparse.zoo.replay import BufferSaver, end_episodes, restore_buffer

VECTOR = spaces.Box(-1, 1, (3,), np.float32)
DICT = spaces.Dict({"a": VECTOR, "b": spaces.Box(0, 255, (2, 2), np.uint8)})
ACTIONS = spaces.Discrete(2)
KINDS = {
    "vectors": lambda size: ReplayBuffer(size * 2, VECTOR, ACTIONS, n_envs=2),
    "dicts": lambda size: DictReplayBuffer(size * 2, DICT, ACTIONS, n_envs=2),
    "one array": lambda size: ReplayBuffer(
        size * 2,
        VECTOR,
        ACTIONS,
        n_envs=2,
        optimize_memory_usage=True,
        handle_timeout_termination=False,
    ),
}


def observation(space, rng):
    if isinstance(space, spaces.Dict):
        return {key: observation(part, rng) for key, part in space.items()}
    return rng.integers(0, 200, (2, *space.shape)).astype(space.dtype)


def fill(buffer, count, rng):
    for _ in range(count):
        buffer.add(
            observation(buffer.observation_space, rng),
            observation(buffer.observation_space, rng),
            rng.integers(0, 2, (2, 1)),
            rng.random(2),
            rng.random(2) < 0.1,
            [{}, {}],
        )


def assert_same(one, other):
    assert (one.pos, one.full) == (other.pos, other.full)
    filled = one.buffer_size if one.full else min(one.pos + 1, one.buffer_size)
    for name, value in vars(one).items():
        again = getattr(other, name)
        if isinstance(value, dict):
            for key, part in value.items():
                assert np.array_equal(part[:filled], again[key][:filled]), (name, key)
        elif isinstance(value, np.ndarray):
            assert (value[:filled] == again[:filled]).all(), name


@pytest.mark.parametrize("kind", KINDS)
@given(
    size=st.integers(2, 40),
    counts=st.lists(st.integers(0, 100), min_size=1, max_size=6),
    rows=st.integers(1, 15),
)
@settings(max_examples=60, deadline=None)
def test_every_save_is_complete(kind, size, counts, rows):
    rng = np.random.default_rng(0)
    before, replay.ROWS = replay.ROWS, rows
    try:
        with TemporaryDirectory() as folder:
            buffer = KINDS[kind](size)
            saver, added = BufferSaver(buffer), 0
            for number, count in enumerate(counts):
                fill(buffer, count, rng)
                added += count
                path = Path(folder) / str(number)
                saver.save(path, added)
                saver.last = path
                again = KINDS[kind](size)
                restore_buffer(again, path)
                assert_same(buffer, again)
    finally:
        replay.ROWS = before


def test_a_save_writes_what_is_new_and_links_the_rest(tmp_path, monkeypatch):
    monkeypatch.setattr(replay, "ROWS", 10)
    buffer = ReplayBuffer(200, VECTOR, ACTIONS, n_envs=2)
    saver, rng = BufferSaver(buffer), np.random.default_rng(0)
    fill(buffer, 35, rng)
    saver.save(tmp_path / "first", 35)
    saver.last = tmp_path / "first"
    fill(buffer, 3, rng)
    saver.save(tmp_path / "second", 38)
    files = {path.name: path.stat().st_ino for path in (tmp_path / "first").glob("*.npz")}
    again = {path.name: path.stat().st_ino for path in (tmp_path / "second").glob("*.npz")}
    assert set(files) == set(again) == {"0.npz", "1.npz", "2.npz", "3.npz"}
    assert [name for name in sorted(files) if files[name] != again[name]] == ["3.npz"]


@pytest.mark.parametrize("kind", ["vectors", "one array"])
def test_an_episode_under_way_is_ended_where_it_was_cut(kind):
    buffer = KINDS[kind](20)
    end_episodes(buffer)  # nothing there yet
    fill(buffer, 7, np.random.default_rng(0))
    dones, timeouts = buffer.dones.copy(), buffer.timeouts.copy()
    end_episodes(buffer)
    assert (buffer.dones[:6] == dones[:6]).all()
    assert (buffer.timeouts[:6] == timeouts[:6]).all()
    if kind == "one array":
        assert (buffer.dones[6] == 1).all()
    else:
        assert (buffer.timeouts[6] == 1).all()
        assert (buffer.dones[6] == dones[6]).all()


def test_hindsight_replay_comes_back_without_its_unfinished_episode(tmp_path):
    def make():
        return DQN(
            "MultiInputPolicy",
            BitFlippingEnv(n_bits=5, max_steps=5),
            replay_buffer_class=HerReplayBuffer,
            learning_starts=1000,
            buffer_size=60,
            seed=0,
        )

    model, again = make(), make()
    model.learn(83)
    BufferSaver(model.replay_buffer).save(tmp_path / "her", 83)
    restore_buffer(again.replay_buffer, tmp_path / "her")
    end_episodes(again.replay_buffer)
    assert again.replay_buffer.full
    lengths = again.replay_buffer.ep_length
    assert (lengths <= 5).all()
    sample = again.replay_buffer.sample(16)
    assert sample.observations["observation"].shape[0] == 16


def delete(path):
    path.unlink()


def halve(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def drop_key(path):
    with np.load(path) as saved:
        kept = dict(saved)
    kept.popitem()
    np.savez(path, **kept)


def shorten(path):
    with np.load(path) as saved:
        kept = {key: rows[:-1] for key, rows in saved.items()}
    np.savez(path, **kept)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("name", "spoil", "said"),
    [
        ("0.npz", delete, "0.npz is missing"),
        ("2.npz", delete, "2.npz is missing"),
        ("rest.pkl", delete, "rest.pkl is missing"),
        ("1.npz", halve, "1.npz is damaged"),
        ("rest.pkl", halve, "rest.pkl is damaged"),
        ("1.npz", drop_key, "1.npz should hold .* and holds None"),
        ("2.npz", shorten, "2.npz should hold"),
    ],
)
def test_a_buffer_of_which_a_part_is_lost_is_refused_and_never_filled_with_zeros(
    kind, name, spoil, said, tmp_path, monkeypatch
):
    monkeypatch.setattr(replay, "ROWS", 10)
    buffer = KINDS[kind](50)
    fill(buffer, 25, np.random.default_rng(0))
    BufferSaver(buffer).save(tmp_path / "b", 25)
    restore_buffer(KINDS[kind](50), tmp_path / "b")  # as it is, it goes
    spoil(tmp_path / "b" / name)
    with pytest.raises(ConfigError, match=f"is incomplete: {said}.*delete that folder to continue"):
        restore_buffer(KINDS[kind](50), tmp_path / "b")


def test_a_buffer_of_another_size_is_refused(tmp_path):
    buffer = KINDS["vectors"](50)
    fill(buffer, 25, np.random.default_rng(0))
    BufferSaver(buffer).save(tmp_path / "b", 25)
    with pytest.raises(ConfigError, match=r"rest\.pkl is of 50 rows, not 40"):
        restore_buffer(KINDS["vectors"](40), tmp_path / "b")
