"""``predict`` for a few observations, as in a rollout: SB3's results in fewer steps."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy

from sb3_sparse.engine.boxes import CLIP, SCALE, UNSCALE, Bounds
from sb3_sparse.engine.native.library import why_missing
from sb3_sparse.policies.fast_forward import overrides
from sb3_sparse.policies.training_mode import FastModeSwitch

Actions = NDArray[Any]
BYPASSED = (
    "set_training_mode",
    "obs_to_tensor",
    "is_vectorized_observation",
    "extract_features",
    "forward",
    "_predict",
    "unscale_action",
)
"""Methods that SB3's ``predict`` calls. Where a user overrides one, SB3's ``predict`` runs."""


class FastPredict(FastModeSwitch, BasePolicy):
    """A policy, or a module of one, that predicts in one call of the kernels where it can."""

    _bounds: Bounds | None = None

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
            return super().predict(observation, state, episode_start, deterministic)
        return actions, state

    def _predicted(self, observation: Any, deterministic: bool) -> Actions | None:
        """Actions that the kernels compute; None: SB3 has to predict."""
        if type(observation) is not np.ndarray or overrides(self, BYPASSED):
            return None
        alone = observation.shape == self.observation_space.shape
        if not alone and observation.shape[1:] != self.observation_space.shape:
            return None
        acted = self._fast_actions(observation[None] if alone else observation, deterministic)
        if acted is None:
            return None
        self._ensure_evaluation_mode()
        actions, space = acted, self.action_space
        if isinstance(space, spaces.Box):
            actions = acted.reshape((-1, *space.shape))
            if self.squash_output:
                actions = self.unscale_action(actions)
            else:
                clipped = self._in_box(actions, CLIP)
                actions = actions.clip(space.low, space.high) if clipped is None else clipped
        return actions.squeeze(axis=0) if alone else actions

    def scale_action(self, action: Actions) -> Actions:
        """As in SB3."""
        scaled = self._in_box(action, SCALE)
        return super().scale_action(action) if scaled is None else scaled

    def unscale_action(self, scaled_action: Actions) -> Actions:
        """As in SB3."""
        unscaled = self._in_box(scaled_action, UNSCALE)
        return super().unscale_action(scaled_action) if unscaled is None else unscaled

    def _in_box(self, actions: Actions, how: int) -> Actions | None:
        """Actions clipped or scaled by the kernels, see :meth:`Bounds.of`; None: NumPy has to."""
        space, bounds = self.action_space, self._bounds
        if not isinstance(space, spaces.Box) or type(actions) is not np.ndarray:
            return None
        if bounds is None or bounds.low is not space.low or bounds.high is not space.high:
            if why_missing() is not None or not Bounds.readable(space.low, space.high):
                return None
            bounds = self._bounds = Bounds(space.low, space.high)
        return bounds.of(actions, how)

    @abstractmethod
    def _fast_actions(self, observations: Actions, deterministic: bool) -> Actions | None:
        """Actions before scaling, computed by the kernels; None: the modules have to be called.

        :param observations: shape ``(n, *shape of an observation)``, any dtype
        """
