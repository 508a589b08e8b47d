"""Reads the zip of a model saved by SB3, completely or without unpickling."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_sparse.errors import ConfigError, CorruptStateError, Diverged
from sb3_sparse.loading.guard import reading
from sb3_sparse.loading.sbx import ROOMY, is_sbx, unsupported

WHAT = "model saved by SB3"
CURE = "give a model saved by SB3, e.g. model.zip, or an earlier checkpoint"
MASK = "_mask"


@dataclass(frozen=True)
class Contents:
    """The contents of a model's file that can be read without running code from it.

    :param data: the model's attributes; for pickled ones, the plain values that SB3 writes too
    :param state: the policy's state_dict
    """

    data: dict[str, Any]
    state: dict[str, Any]


def look_into(path: Path) -> Contents:
    """Read names, shapes and values of a saved model; nothing is unpickled, so any file is safe.

    :raises ConfigError: if the file cannot be opened
    :raises CorruptStateError: if the file is not a model
    :raises UnsupportedError: if SBX saved the file
    """
    _check_file(path)
    with reading(path, WHAT, CURE), zipfile.ZipFile(path) as archive:
        for member in ("data", "policy.pth"):
            if member not in archive.namelist():
                raise CorruptStateError(f"{path} is damaged: {member} is missing; {CURE}")
            if archive.getinfo(member).file_size > ROOMY:
                raise CorruptStateError(f"{path} is damaged: {member} is too large; {CURE}")
        data = json.loads(archive.read("data"))
        state = th.load(
            io.BytesIO(archive.read("policy.pth")), map_location="cpu", weights_only=True
        )
    if not isinstance(data, dict):
        raise CorruptStateError(f"{path} is damaged: its data are not a mapping; {CURE}")
    return Contents(data, _checked(path, state))


def read_model(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a model's attributes and its policy's state_dict.

    This unpickles the attributes, as SB3's ``load`` does, so the file must be trusted.

    :raises ConfigError: if the file cannot be opened
    :raises CorruptStateError: if the file is not a model
    :raises UnsupportedError: if SBX saved the file
    """
    _check_file(path)
    with reading(path, WHAT, CURE):
        data, params, _ = load_from_zip_file(path, device="cpu")
    if not isinstance(data, dict) or "policy" not in params:
        raise CorruptStateError(f"{path} is damaged: it has no data or no policy in it; {CURE}")
    return data, _checked(path, params["policy"])


def check_state(state: Mapping[str, Any], where: str) -> None:
    """Reject a network that is not finite, or whose masks contradict its weights.

    :param state: a policy's state_dict
    :param where: the model's name in errors, e.g. its path
    :raises Diverged: if a value is NaN or infinite
    :raises CorruptStateError: for inactive weights other than 0, which loading would set to 0
    """
    check_finite(state, where)
    for name, mask in state.items():
        weight = state.get(name.removesuffix(MASK)) if name.endswith(MASK) else None
        if not isinstance(weight, th.Tensor) or not isinstance(mask, th.Tensor):
            continue
        if mask.shape != weight.shape:
            raise CorruptStateError(
                f"{where} is damaged: the mask of {name.removesuffix('.weight_mask')} has shape "
                f"{tuple(mask.shape)}, its weight {tuple(weight.shape)}; take an earlier one"
            )
        wrong = int((weight[~mask.bool()] != 0).sum())
        if wrong:
            raise CorruptStateError(
                f"masks and weights disagree in {where}: {wrong} connections of "
                f"{name.removesuffix('.weight_mask')} are not 0 though its mask has them "
                "inactive; the file was changed. Take an earlier one, or load it with "
                "<algorithm>.load, which sets them to 0, and save it again"
            )


def check_finite(state: Mapping[str, Any], where: str) -> None:
    """Reject a network with values that are NaN or infinite.

    :param state: a policy's state_dict
    :param where: the model's name in errors, e.g. its path
    :raises Diverged: names the first such tensor and the number of others
    """
    found: dict[str, str] = {}
    for name, tensor in state.items():
        if isinstance(tensor, th.Tensor) and tensor.is_floating_point():
            wrong = tensor.numel() - int(tensor.isfinite().sum())
            if wrong:
                found[name] = f"{wrong} of {tensor.numel()} values of {name} are not finite"
    if found:
        more = f" (and {len(found) - 1} more tensors)" if len(found) > 1 else ""
        raise Diverged(
            f"the training of {where} diverged: {next(iter(found.values()))}{more}. Take "
            "an earlier checkpoint or best_model.zip, if they are finite, or train again with a "
            "smaller learning rate"
        )


def _check_file(path: Path) -> None:
    if not path.is_file():
        raise ConfigError(f"there is no file {path}; {CURE}")
    if is_sbx(path):
        raise unsupported(path)


def _checked(path: Path, state: Any) -> dict[str, Any]:
    """Check that a policy is a state_dict, and return a copy."""
    if not isinstance(state, dict) or not all(isinstance(name, str) for name in state):
        raise CorruptStateError(f"{path} is damaged: its policy is not a state_dict; {CURE}")
    return dict(state)
