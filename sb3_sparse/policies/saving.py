"""What SB3 would write to a model's file."""

from __future__ import annotations

import io
import pickle
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file

BROKEN_PICKLE = (
    pickle.UnpicklingError,
    EOFError,
    ImportError,
    AttributeError,
    AssertionError,
    ValueError,
    IndexError,
    TypeError,
    KeyError,
)
"""What loading something else than a pickle of ours may raise."""


def parts_of(model: BaseAlgorithm) -> tuple[dict[str, Any], dict[str, Any], Any]:
    """A model as ``save`` writes and ``load`` reads it: data, state_dicts by name, variables.

    Copies, on the CPU.
    """
    file = io.BytesIO()
    model.save(file)
    file.seek(0)
    data, params, variables = load_from_zip_file(file, device="cpu")
    assert data is not None
    return data, dict(params), variables


def was_normalised(model: BaseAlgorithm) -> bool:
    """Whether an on-policy model was trained under a VecNormalize, as far as it remembers.

    Off-policy models do not tell.
    """
    if not isinstance(model, OnPolicyAlgorithm):
        return False
    return differ(model._last_obs, model._last_original_obs)


def differ(seen: Any, raw: Any) -> bool:
    """Whether an observation is not what it was before normalisation; not, if one is unknown."""
    if seen is None or raw is None:
        return False
    if isinstance(raw, dict):
        return any(differ(seen[key], raw[key]) for key in raw)
    return not np.array_equal(seen, raw)
