"""Writes a sparse model as a zip of stock SB3, which needs nothing of this package."""

from __future__ import annotations

import base64
import io
import json
import zipfile
from typing import Any

import stable_baselines3
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import is_json_serializable

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export.pathless import pickled
from sb3_sparse.policies.arguments import import_classes
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.config import SparsityConfig
from sb3_sparse.policies.internals import LAST_SEEN
from sb3_sparse.policies.saving import parts_of
from sb3_sparse.policies.simba import SimbaPolicy

STOCK = ("stable_baselines3.", "sb3_contrib.")
FORGOTTEN = (
    *LAST_SEEN,
    "ep_info_buffer",
    "ep_success_buffer",
    "tensorboard_log",
    "start_time",
)
"""Attributes about where and when a model was trained; ``learn`` sets them again."""
LONG_AGO = (1980, 1, 1, 0, 0, 0)


def write_dense(model: BaseAlgorithm) -> bytes:
    """Return the bytes of the zip; weights and optimizer moments are 0 without a connection.

    If stock SB3 trains the model further, it becomes dense: nothing keeps the zeros.

    :raises UnsupportedError: if the model needs classes of this package
    """
    data, params, variables = parts_of(model)
    policy = unwrapped(model.policy)
    data["policy_class"] = _stock_class(type(policy))
    data["policy_kwargs"] = _stock_kwargs(policy, data["policy_kwargs"])
    if getattr(data.get("replay_buffer_class"), "__module__", "").startswith("sb3_sparse."):
        data |= _stock_buffer(data["replay_buffer_kwargs"])
    for name in FORGOTTEN:
        if name in data:
            data[name] = None
    params["policy"] = {
        key: value
        for key, value in params["policy"].items()
        if not key.endswith((".weight_mask", "_extra_state"))
    }
    return _zipped(data, params, variables)


def _stock_class(policy: type[BasePolicy]) -> type[BasePolicy]:
    """Return the stock class below a sparse policy class; any other class unchanged."""
    if not issubclass(policy, BaseSparsePolicy):
        return policy
    if issubclass(policy, SimbaPolicy):
        raise UnsupportedError(
            f"{policy.__name__} is made of SimBa networks, which stock SB3 does not have; export "
            "to onnx, numpy or c instead"
        )
    for cls in policy.__mro__:
        if cls.__module__.startswith(STOCK):
            assert issubclass(cls, BasePolicy)
            return cls
        if not cls.__module__.startswith("sb3_sparse."):
            break
    raise UnsupportedError(
        f"{policy.__module__}.{policy.__qualname__} is your own sparse policy, which has no stock "
        "class; export to onnx, numpy or c instead"
    )


def _stock_kwargs(policy: BasePolicy, kwargs: dict[str, Any]) -> dict[str, Any]:
    """Remove the arguments of sparse policies, and import the classes among the others."""
    sparse = SparsityConfig.__dataclass_fields__
    stock = {name: value for name, value in kwargs.items() if name not in sparse}
    import_classes(stock)
    if isinstance(policy, BaseSparsePolicy):  # whose default may differ
        stock["features_extractor_class"] = policy.features_extractor_class
    return stock


def _stock_buffer(kwargs: dict[str, Any]) -> dict[str, Any]:
    """Return the attributes that name SB3's replay buffer in place of one of this package.

    :param kwargs: arguments of the latter
    """
    if kwargs.keys() & {"n_steps", "gamma"}:  # returns over several steps that the user chose
        buffer, kwargs = NStepReplayBuffer, {"n_steps": 1, **kwargs}
        return {"replay_buffer_class": buffer, "replay_buffer_kwargs": kwargs}
    return {"replay_buffer_class": None}  # SB3 chooses


def _zipped(data: dict[str, Any], params: Any, variables: Any) -> bytes:
    """Write a zip as SB3 does, but with the same bytes each time."""
    texts = {name: _as_json(name, value) for name, value in data.items()}
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        _add(archive, "data", json.dumps(texts, indent=4).encode())
        if variables is not None:
            _add(archive, "pytorch_variables.pth", _saved(variables))
        for name, state in params.items():
            _add(archive, f"{name}.pth", _saved(state))
        _add(archive, "_stable_baselines3_version", stable_baselines3.__version__.encode())
    return file.getvalue()


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    archive.writestr(zipfile.ZipInfo(name, LONG_AGO), content)


def _as_json(name: str, value: Any) -> Any:
    if is_json_serializable(value):
        return value
    content = pickled(value)
    if b"sb3_sparse" in content:
        raise UnsupportedError(
            f"the model's {name} is {value}, which needs sb3_sparse to be loaded; dense zips may "
            "contain SB3's networks and your own classes. Export to onnx, numpy or c instead"
        )
    return {":type:": str(type(value)), ":serialized:": base64.b64encode(content).decode()}


def _saved(state: Any) -> bytes:
    file = io.BytesIO()
    th.save(state, file)
    return file.getvalue()
