"""Predictions of a few observations, as in a rollout: SB3's results with fewer steps on the way."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy

from sb3_sparse.engine.inference import MOST_INPUTS
from sb3_sparse.policies.modes import SwitchesModes
from sb3_sparse.policies.shortcut import takes_vectors, untouched

Actions = NDArray[Any]
ON_THE_WAY = (
    "set_training_mode",
    "obs_to_tensor",
    "is_vectorized_observation",
    "extract_features",
    "forward",
    "_predict",
    "unscale_action",
)
"""What ``predict`` calls; a subclass of the user's own that has one of them gets SB3's."""


class Acts(SwitchesModes, BasePolicy):
    """A policy or part of one that predicts."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._takes_vectors = takes_vectors(self)

    def predict(
        self,
        observation: Any,
        state: tuple[Actions, ...] | None = None,
        episode_start: Actions | None = None,
        deterministic: bool = False,
    ) -> tuple[Actions, tuple[Actions, ...] | None]:
        """As in SB3."""
        actions = self._predicted(observation, deterministic)
        if actions is None:
            self._enforce()
            return super().predict(observation, state, episode_start, deterministic)
        return actions, state

    def _predicted(self, observation: Any, deterministic: bool) -> Actions | None:
        """Actions for vectors of numbers; None for anything else, about which SB3 knows more."""
        if (
            type(observation) is not np.ndarray
            or not self._takes_vectors
            or not untouched(self, ON_THE_WAY)
        ):
            return None
        shape, acts = self.observation_space.shape or (), self.action_space.shape or ()
        alone = observation.shape == shape
        if not alone and observation.shape[1:] != shape:
            return None
        obs = th.from_numpy(np.array(observation).reshape((-1, *shape)))
        if not self._prepare_to_act(len(obs)):
            obs = obs.to(self.device)
        with th.no_grad():
            acted = self._predict(obs, deterministic)
        actions: Actions = acted.cpu().numpy().reshape((-1, *acts))
        if isinstance(self.action_space, spaces.Box):
            if self.squash_output:
                actions = self.unscale_action(actions)
            else:
                actions = np.clip(actions, self.action_space.low, self.action_space.high)
        return actions.squeeze(axis=0) if alone else actions

    def _prepare_to_act(self, count: int) -> bool:
        """Be in evaluation mode; whether the kernels will act.

        If not, inactive weights are set to 0, since modules will read them.

        :param count: number of observations
        """
        self._switch(False)
        if self.by_kernels and count <= MOST_INPUTS:
            return True
        self._enforce()
        return False

    @property
    @abstractmethod
    def by_kernels(self) -> bool:
        """Whether the kernels acted the last time."""

    @abstractmethod
    def _enforce(self) -> None:
        """Set inactive weights to 0 that somebody has written."""
