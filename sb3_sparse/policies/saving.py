"""What SB3 would write to a model's file."""

from __future__ import annotations

import io
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file


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
