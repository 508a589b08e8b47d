"""Wrappers that add noise to observations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers.utils import RunningMeanStd
from numpy.typing import NDArray

from sb3_sparse.errors import ConfigError
from sb3_sparse.sparsity.numeric import is_number

Array = NDArray[Any]


class Noise(gym.ObservationWrapper[Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Base class with a generator for the noise, which ``reset(seed=...)`` seeds.

    The environment's own generator is not used, so that the same seed and the same actions give
    the same episode with and without noise.

    :param env: environment
    :param sigma: standard deviation, 0 or more
    """

    def __init__(self, env: gym.Env[Any, Any], sigma: float, **arguments: Any) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, sigma=sigma, **arguments)
        super().__init__(env)
        if not is_number(sigma) or not 0 <= sigma < np.inf:
            raise ConfigError(f"sigma must be a number, 0 or more, got {sigma!r}")
        self.sigma = float(sigma)
        self.generator = np.random.default_rng()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """As in Gymnasium; the first observation is noisy too."""
        if seed is not None:
            self.generator = np.random.default_rng(seed)
        return super().reset(seed=seed, options=options)

    def _rejected(self, takes: str, instead: str) -> ConfigError:
        return ConfigError(
            f"{type(self).__name__} takes {takes}, got {self.observation_space}; {instead}"
        )


class PixelNoise(Noise):
    """Adds ``round(N(0, sigma))`` to every pixel, saturating at 0 and 255.

    Put it below frame stacking (in an rl-zoo ``env_wrapper`` list, after ``AtariWrapper``), so that
    every frame gets its noise once and keeps it while it is stacked.

    :param env: environment whose observations are images, uint8
    :param sigma: standard deviation in grey levels, 0 or more; the paper takes 0 to 30
    :raises ConfigError: for other observations or a negative sigma

    Source: arXiv:2206.10369, section on noise robustness. Its reference code wraps around at 0 and
    255, unlike here.
    """

    def __init__(self, env: gym.Env[Any, Any], sigma: float) -> None:
        super().__init__(env, sigma)
        space = self.observation_space
        if not isinstance(space, spaces.Box) or space.dtype != np.uint8:
            raise self._rejected("images of type uint8", "vectors take ObservationNoise")

    def observation(self, observation: Array) -> Array:
        """The noisy image, uint8, of the same shape."""
        noise = np.rint(self.generator.normal(0.0, self.sigma, observation.shape))
        noisy: Array = np.clip(observation + noise, 0, 255).astype(np.uint8)
        return noisy


class ObservationNoise(Noise):
    """Adds ``N(0, sigma * std)`` to every feature, within the bounds of the observation space.

    :param env: environment whose observations are vectors of floats
    :param sigma: standard deviation in units of each feature's own, 0 or more
    :param std: standard deviation of each feature, shape as an observation; None: that of the
        clean observations seen since the last seeded reset (the first has no noise then)
    :raises ConfigError: for other observations, a negative sigma or a std that does not fit
    """

    def __init__(
        self, env: gym.Env[Any, Any], sigma: float, std: Sequence[float] | None = None
    ) -> None:
        super().__init__(env, sigma, std=std)
        space = self.observation_space
        if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.floating):
            raise self._rejected("vectors of floats", "images take PixelNoise")
        self.space = space
        self.seen = self._nothing_seen() if std is None else None
        self.std = np.zeros(space.shape) if std is None else np.asarray(std, np.float64)
        if self.std.shape != space.shape or (self.std < 0).any() or not np.isfinite(self.std).all():
            raise ConfigError(
                f"std must be {space.shape} numbers, 0 or more, one for each feature, got {std!r}"
            )

    def _nothing_seen(self) -> RunningMeanStd:
        return RunningMeanStd(epsilon=0.0, shape=self.space.shape)  # type: ignore[no-untyped-call]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """As in Gymnasium; after a seed, all noise depends on it alone."""
        if seed is not None and self.seen is not None:
            self.seen = self._nothing_seen()
        return super().reset(seed=seed, options=options)

    def observation(self, observation: Array) -> Array:
        """The noisy vector, of the same type and shape."""
        if self.seen is not None:
            self.seen.update(observation[None])  # type: ignore[no-untyped-call]
            self.std = np.sqrt(self.seen.var)
        noise = self.generator.normal(0.0, 1.0, observation.shape) * self.sigma * self.std
        noisy = np.clip(observation + noise, self.space.low, self.space.high)
        return noisy.astype(self.space.dtype)
