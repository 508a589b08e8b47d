"""The zip of a model, as SB3 saves it: looked into, or read whole."""

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

WHAT = "model saved by SB3"
CURE = "give a model saved by SB3, e.g. model.zip, or an earlier checkpoint"
MASK = "_mask"
ROOMY = 2**34
"""Bytes of one member that no policy needs, and a damaged header may claim."""


@dataclass(frozen=True)
class Contents:
    """What can be seen of a model without running anything that its file says.

    :param data: the model's attributes; of what SB3 pickles, the plain values that it writes beside
    :param state: the policy's state_dict
    """

    data: dict[str, Any]
    state: dict[str, Any]


def look_into(path: Path) -> Contents:
    """Names, shapes and values of a saved model; nothing is unpickled, so any file is safe.

    :raises ConfigError: if it cannot be opened
    :raises CorruptStateError: if it is no model
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
        raise CorruptStateError(f"{path} is damaged: its data are no mapping; {CURE}")
    return Contents(data, _checked(path, state))


def read_model(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """What SB3 saved: data, and the policy's state_dict.

    Unpickles the data, as SB3's ``load`` does: the file must come from somebody who is trusted.

    :raises ConfigError: if it cannot be opened
    :raises CorruptStateError: if it is no model
    """
    _check_file(path)
    with reading(path, WHAT, CURE):
        data, params, _ = load_from_zip_file(path, device="cpu")
    if not isinstance(data, dict) or "policy" not in params:
        raise CorruptStateError(f"{path} is damaged: it has no data or no policy in it; {CURE}")
    return data, _checked(path, params["policy"])


def check_state(state: Mapping[str, Any], where: str) -> None:
    """Refuse a network that is not finite, or whose masks contradict its weights.

    :param state: a policy's state_dict
    :param where: what to call the model in the error, e.g. its path
    :raises Diverged: if a value is NaN or infinite
    :raises CorruptStateError: for weights where their mask has none, which loading would set to 0
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
                "inactive; somebody changed the file. Take an earlier one, or load it with "
                "<algorithm>.load, which sets them to 0, and save it again"
            )


def check_finite(state: Mapping[str, Any], where: str) -> None:
    """Refuse a network with values that are NaN or infinite.

    :param state: a policy's state_dict
    :param where: what to call the model in the error, e.g. its path
    :raises Diverged: if so; names the first such layer and how many more there are
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
            "an earlier checkpoint or best_model.zip, if they are finite, or train anew with a "
            "smaller learning rate"
        )


def _check_file(path: Path) -> None:
    if not path.is_file():
        raise ConfigError(f"there is no file {path}; {CURE}")


def _checked(path: Path, state: Any) -> dict[str, Any]:
    """A state_dict: tensors by name, and what else modules keep."""
    if not isinstance(state, dict) or not all(isinstance(name, str) for name in state):
        raise CorruptStateError(f"{path} is damaged: its policy is no state_dict; {CURE}")
    return dict(state)
