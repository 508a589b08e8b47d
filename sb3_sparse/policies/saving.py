"""What SB3 would write to a model's file."""

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
    """A model as ``save`` writes and ``load`` reads it: data, state_dicts by name, variables.

    Copies, on the CPU.
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
    """A saved model with all its settings, but no replay buffer: for all except training.

    A buffer would take memory, and that of hindsight experience replay asks for the environment.

    :param kwargs: of SB3's ``load``
    """
    if issubclass(algorithm, OffPolicyAlgorithm):
        kwargs["replay_buffer"] = object()  # SB3 makes one where there is none
    model: Algorithm = algorithm.load(file, **kwargs)
    if isinstance(model, OffPolicyAlgorithm):
        model.replay_buffer = None
    return model


def was_normalised(model: BaseAlgorithm) -> bool:
    """Whether an on-policy model was trained under a VecNormalize, as far as it remembers.

    Off-policy models do not tell.
    """
    if not isinstance(model, OnPolicyAlgorithm):
        return False
    return differ(*last_observations(model))


def differ(seen: Any, raw: Any) -> bool:
    """Whether an observation is not what it was before normalisation; not, if one is unknown."""
    if seen is None or raw is None:
        return False
    if isinstance(raw, dict):
        return any(differ(seen[key], raw[key]) for key in raw)
    return not np.array_equal(seen, raw)
