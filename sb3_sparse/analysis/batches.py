"""Minibatches to measure on, drawn without changing what training draws."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer

from sb3_sparse.errors import ConfigError


@contextmanager
def own_randomness(seed: int, device: th.device) -> Iterator[None]:
    """Seed the global generators of NumPy and torch, and restore their states afterwards.

    :param seed: 0 or more
    :param device: its generator is restored too
    """
    before = np.random.get_state()
    with th.random.fork_rng([device] if device.type == "cuda" else []):
        try:
            np.random.seed(seed % 2**32)
            th.manual_seed(seed)
            yield
        finally:
            np.random.set_state(before)


def has_batch(model: BaseAlgorithm) -> bool:
    """Whether the replay buffer has transitions, or a rollout is complete."""
    replay, rollout = _buffers(model)
    return (replay is not None and replay.size() > 0) or (rollout is not None and rollout.full)


def sample_batch(model: BaseAlgorithm, batch_size: int | None = None, seed: int = 0) -> Any:
    """A minibatch as the algorithm's ``train()`` draws one: from its replay or rollout buffer.

    :param model: an SB3 model whose buffer is not empty
    :param batch_size: samples; None: as many as the algorithm takes
    :param seed: seed of the draw
    :return: SB3's named tuple
    :raises ConfigError: if there is no buffer, or it is empty
    """
    replay, rollout = _buffers(model)
    if not has_batch(model):
        raise ConfigError(
            f"{type(model).__name__} has nothing to measure on: no replay buffer with transitions "
            "and no complete rollout; let it learn, load its replay buffer, or pass a batch"
        )
    size = getattr(model, "batch_size", None) if batch_size is None else batch_size
    with own_randomness(seed, model.device):
        if replay is not None:
            return replay.sample(int(size or 256), env=model.get_vec_normalize_env())
        assert rollout is not None
        copied = copy.copy(rollout)  # the first get() flattens its arrays
        if isinstance(copied.observations, dict):
            vars(copied)["observations"] = dict(copied.observations)
        return next(copied.get(size))


def _buffers(model: BaseAlgorithm) -> tuple[ReplayBuffer | None, RolloutBuffer | None]:
    return getattr(model, "replay_buffer", None), getattr(model, "rollout_buffer", None)
