"""The content of a model's file."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_sparse.policies.compiled import plain_names
from sb3_sparse.policies.internals import last_observations

Algorithm = TypeVar("Algorithm", bound=BaseAlgorithm)


def parts_of(model: BaseAlgorithm) -> tuple[dict[str, Any], dict[str, Any], Any]:
    """A model as ``save`` writes it and ``load`` reads it: data, state_dicts by name, variables.

    The tensors are copies on the CPU.
    """
    file = io.BytesIO()
    model.save(file)
    file.seek(0)
    data, loaded, variables = load_from_zip_file(file, device="cpu")
    assert data is not None
    params: dict[str, Any] = dict(loaded)
    params["policy"] = plain_names(params["policy"])
    return data, params, variables


def load_without_buffer(
    algorithm: type[Algorithm], file: str | Path | io.BufferedIOBase, **kwargs: Any
) -> Algorithm:
    """A saved model without a replay buffer, for everything but training.

    A buffer would take memory, and one for hindsight experience replay needs the environment.

    :param kwargs: further arguments of SB3's ``load``
    """
    if issubclass(algorithm, OffPolicyAlgorithm):
        kwargs["replay_buffer"] = object()  # or SB3 makes one
    model: Algorithm = algorithm.load(file, **kwargs)
    if isinstance(model, OffPolicyAlgorithm):
        model.replay_buffer = None
    return model


def was_normalised(model: BaseAlgorithm) -> bool:
    """Whether an on-policy model was trained under a VecNormalize; False for others.

    Off-policy models keep nothing that would tell.
    """
    if not isinstance(model, OnPolicyAlgorithm):
        return False
    return differ(*last_observations(model))


def differ(seen: Any, raw: Any) -> bool:
    """Whether an observation differs from what it was before normalisation; False if unknown."""
    if seen is None or raw is None:
        return False
    if isinstance(raw, dict):
        return any(differ(seen[key], raw[key]) for key in raw)
    return not np.array_equal(seen, raw)
