"""Models saved by SBX, which is SB3 in JAX: recognised without unpickling, and loaded."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_sparse.errors import ConfigError, CorruptStateError, MissingExtra, UnsupportedError
from sb3_sparse.loading.guard import reading

WHAT = "model saved by SBX"
CURE = "give a model saved by SBX, or an earlier checkpoint"
ROOMY = 2**34
"""Bytes of a member that no model reaches, but a damaged header may claim."""
ALGORITHMS = ("dqn", "sac", "td3", "ddpg", "ppo", "tqc", "crossq")
NO_BUFFER: dict[str, Any] = {
    "buffer_size": 1,
    "replay_buffer_class": None,
    "replay_buffer_kwargs": {},
    "n_steps": 1,
    "optimize_memory_usage": False,
}
"""Attributes with which SBX makes a replay buffer that takes no memory and needs no environment."""


def is_sbx(path: Path) -> bool:
    """Tell whether SBX saved a zip; nothing is unpickled. False for what is not a zip of a model.

    SBX keeps networks among the pickled attributes, where SB3 has a ``policy.pth``.
    """
    return bool(_modules(path))


def sbx_algorithms(path: Path) -> list[str]:
    """Return the algorithms of SBX that may have saved a zip; nothing is unpickled.

    TD3 and DDPG share a policy class.

    :return: lower-case names, the likeliest first
    :raises UnsupportedError: if it names none
    """
    for name in _modules(path):
        algo = name.split(".")[1]
        if algo in ALGORITHMS:
            return [algo, "ddpg"] if algo == "td3" else [algo]
    raise UnsupportedError(
        f"{path} is of no algorithm of SBX that is known; known are {', '.join(ALGORITHMS)}"
    )


def unsupported(path: Path) -> UnsupportedError:
    """Return the error for a zip of SBX where only one of SB3 will do."""
    return UnsupportedError(
        f"{path} is a model of SBX (SB3 in JAX), which only `sb3-sparse export` and `enjoy` take; "
        f"`sb3-sparse export {path} --to dense sb3.zip` makes a zip of SB3 of it, which also "
        "`compress` takes"
    )


def read_attributes(path: Path, without_policy: bool = False) -> dict[str, Any]:
    """Read the attributes of a model of SBX, including its policy.

    This unpickles them, as SBX's ``load`` does, so the file must be trusted.

    :param without_policy: put None in place of the policy, which is what takes long
    :raises MissingExtra: if SBX is not installed
    :raises CorruptStateError: if the file is damaged, or of versions that do not fit
    """
    _sbx()
    with reading(path, WHAT, CURE):
        instead = {"policy": None} if without_policy else None
        data, _, _ = load_from_zip_file(path, custom_objects=instead, device="cpu")
    if not isinstance(data, dict) or "policy" not in data:  # of which SB3 only warns
        raise CorruptStateError(
            f"the policy in {path} cannot be unpickled: the file is damaged, or was saved with "
            "other versions of SBX, JAX and Flax. Load it where it was trained, or install those "
            "versions"
        )
    return data


def load_sbx(path: Path, algo: str) -> BaseAlgorithm:
    """Load a model of SBX for prediction, without a replay buffer.

    :param algo: lower-case name of its algorithm
    :raises ConfigError: if SBX has no such algorithm
    :raises MissingExtra: if SBX is not installed
    :raises CorruptStateError: as :func:`read_attributes`
    """
    if algo not in ALGORITHMS:
        raise ConfigError(f"SBX has no algorithm {algo!r}; it has {', '.join(ALGORITHMS)}")
    attributes = read_attributes(path)
    sbx = _sbx()
    classes = {name.lower(): getattr(sbx, name) for name in sbx.__all__}
    instead = {**attributes, **NO_BUFFER}  # so that SBX unpickles nothing again
    with reading(path, WHAT, CURE):
        model: BaseAlgorithm = classes[algo].load(path, custom_objects=instead)
    for name in NO_BUFFER:
        if name in attributes:
            setattr(model, name, attributes[name])
    if hasattr(model, "replay_buffer"):
        model.replay_buffer = None
    return model


def _modules(path: Path) -> list[str]:
    """Return the modules of SBX that a zip's attributes name, that of the policy class first."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.namelist()
            if "policy.pth" in members or archive.getinfo("data").file_size > ROOMY:
                return []
            data = json.loads(archive.read("data"))
    except Exception:  # whoever reads the file says what is wrong with it
        return []
    if not isinstance(data, dict):
        return []
    written = [data.pop("policy_class", None), *data.values()]
    values = [value for value in written if isinstance(value, dict)]
    named = [str(value.get("__module__", value.get(":type:"))) for value in values]
    names = [name.removeprefix("<class '") for name in named]
    return [name for name in names if name.startswith("sbx.")]


def _sbx() -> Any:
    try:
        import sbx
    except ImportError as error:
        raise MissingExtra("a model of SBX", "sbx") from error
    return sbx
