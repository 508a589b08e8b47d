"""Private names of Stable-Baselines3 that this package reads, so that a release breaks one file.

Checked against stable_baselines3 2.9.2. Names that a subclass inherits, such as ``self._n_updates``
in an algorithm of this package, stay where the subclass uses them. ``tests/test_private_names.py``
fails when a name is gone, and when another module reads a private name of another object.
"""

from __future__ import annotations

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import RolloutBufferSamples
from stable_baselines3.common.vec_env import VecEnv

LAST_SEEN = ("_last_obs", "_last_original_obs", "_last_episode_starts")
"""Attributes of an algorithm that say where it is in its environment."""
COUNTERS = ("_total_timesteps", "_num_timesteps_at_start", "_n_updates", "_episode_num")
"""Attributes of an algorithm that count what it has done."""

no_schedule = BasePolicy._dummy_schedule
"""The learning rate of a policy that is not trained."""


def planned_timesteps(model: BaseAlgorithm) -> int:
    """Environment steps at which the current training ends."""
    return model._total_timesteps


def timesteps_since_start(model: BaseAlgorithm) -> int:
    """Environment steps that the current training has taken."""
    return model.num_timesteps - model._num_timesteps_at_start


def updates_done(model: BaseAlgorithm) -> int:
    """What the algorithm has counted: off-policy gradient steps, on-policy epochs."""
    return int(model._n_updates)


def progress_remaining(model: BaseAlgorithm) -> float:
    """What schedules go by: 1 at the start of training, 0 at its end."""
    return model._current_progress_remaining


def has_own_logger(model: BaseAlgorithm) -> bool:
    """Whether the user has set the logger."""
    return model._custom_logger


def last_observations(model: BaseAlgorithm) -> tuple[Any, Any]:
    """The last observation, and the same before normalisation."""
    return model._last_obs, model._last_original_obs


def samples(buffer: RolloutBuffer, rows: Any) -> RolloutBufferSamples:
    """Some rows of a rollout.

    :param rows: their numbers
    """
    return buffer._get_samples(rows)


def wrapped(env: VecEnv) -> VecEnv:
    """The environment as an algorithm sees it."""
    return BaseAlgorithm._wrap_env(env, verbose=0, monitor_wrapper=False)


def build_networks(model: BaseAlgorithm) -> None:
    """Make the networks of a model that was made without its setup, and no replay buffer.

    The global random generators are left as they are.
    """
    model.replay_buffer = object()  # type: ignore[attr-defined]  # or SB3 makes one
    with th.random.fork_rng(devices=[]):
        model._setup_model()
    model.replay_buffer = None  # type: ignore[attr-defined]


def space_of(extractor: BaseFeaturesExtractor) -> spaces.Space[Any]:
    """The observations that a features extractor takes."""
    return extractor._observation_space
