"""``sparsity.json``: what a run was asked for, what came out, and how sparse it is."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from sb3_sparse.errors import ConfigError, CorruptStateError
from sb3_sparse.files import written_whole
from sb3_sparse.loading.text import read_json
from sb3_sparse.policies.base import BaseSparsePolicy

NAME = "sparsity.json"
WHAT = "record of a run"
CURE = "restore it from a copy, or remove the run's folder and train anew"
FORMAT = 1
DIVERGED = "diverged"
"""Status of a run whose networks came to hold NaN: it is over, and nothing of it is averaged."""
PACKAGES = (
    "sb3-sparse",
    "stable-baselines3",
    "sb3-contrib",
    "rl_zoo3",
    "torch",
    "gymnasium",
    "numpy",
)


def write_record(folder: Path, **content: Any) -> None:
    """Write the file, whole or not at all. What it had under other names stays."""
    path = folder / NAME
    known = read_json(path, WHAT, CURE) if path.is_file() else {"format": FORMAT}
    with written_whole(path) as new:
        new.write_text(json.dumps({**known, **content}, indent=1, default=_plain) + "\n")


def read_record(folder: Path) -> dict[str, Any]:
    """The content of a run's file.

    :raises ConfigError: if the folder has none
    :raises CorruptStateError: if it is damaged
    """
    path = folder / NAME
    if not path.is_file():
        raise ConfigError(
            f"there is no run of sb3-sparse in {folder} (it would hold {NAME}); give the run's own "
            "folder, e.g. logs/sac/HalfCheetah-v5_1"
        )
    content = read_json(path, WHAT, CURE)
    if not isinstance(content.get("status"), str):
        raise CorruptStateError(f"{path} is damaged: it has no status; {CURE}")
    return content


def _plain(value: Any) -> Any:
    if isinstance(value, type):
        return f"{value.__module__}.{value.__qualname__}"  # which a policy can import again
    if isinstance(value, Mapping):
        return dict(value)
    return str(value)


def versions() -> dict[str, str]:
    """Versions of Python and of every package that decides about a run."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def sparsity_of(policy: BaseSparsePolicy) -> dict[str, Any]:
    """Counts of a policy as it is now: in total, by network and layer by layer.

    ``wanted_nnz`` are the active connections that its settings ask for.
    """
    report = policy.sparsity_report()
    networks = dict.fromkeys(layer.network for layer in report.layers)
    return {
        "total": {
            "sparsity": report.sparsity(),
            "nnz": report.nnz,
            "wanted_nnz": report.nnz + sum(one.final_nnz - one.nnz for one in policy.sparse.layers),
            "parameters": report.parameters,
            "flops": sum(layer.flops for layer in report.layers),
            "dense_flops": sum(layer.dense_flops for layer in report.layers),
        },
        "networks": {name: {"sparsity": report.sparsity(name)} for name in networks},
        "layers": [
            {**asdict(layer), "size": layer.size, "density": layer.density}
            for layer in report.layers
        ],
    }
