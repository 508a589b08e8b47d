"""``compress.json``: the settings and the progress of a compression."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_sparse.compress.guard import Interval
from sb3_sparse.compress.search import Level
from sb3_sparse.errors import ConfigError, CorruptStateError
from sb3_sparse.files import written_whole
from sb3_sparse.loading.guard import reading
from sb3_sparse.loading.text import read_json
from sb3_sparse.policies.compiled import unwrapped

NAME = "compress.json"
FORMAT = 1


@dataclass
class CompressionRecord:
    """All that an interrupted compression resumes from, beside the accepted model.

    :param settings: what decides about the outcome, in plain JSON types
    :param baseline: returns of the original model, by batch
    :param levels: finished levels
    :param checked: returns of the outcome and of the baseline on fresh episodes
    :param finished: whether the outcome is written
    """

    settings: dict[str, Any]
    baseline: dict[int, list[float]] = field(default_factory=dict)
    levels: list[Level] = field(default_factory=list)
    checked: tuple[list[float], list[float]] | None = None
    finished: bool = False

    @property
    def accepted(self) -> int:
        """Number of the last accepted level, from 1; 0: there is none."""
        return max((n for n, level in enumerate(self.levels, 1) if level.accepted), default=0)

    def save(self, folder: Path) -> None:
        """Write the file, whole or not at all."""
        with written_whole(folder / NAME) as new:
            new.write_text(json.dumps({"format": FORMAT, **asdict(self)}, indent=1) + "\n")


def open_record(folder: Path, settings: dict[str, Any]) -> CompressionRecord:
    """Read the record in a folder, or make a new one.

    :raises ConfigError: if the folder holds a compression with other settings
    :raises CorruptStateError: if its file is damaged
    """
    path = folder / NAME
    if not path.is_file():
        return CompressionRecord(settings)
    cure = "remove the folder and start again"
    content = read_json(path, "record of a compression", cure)
    with reading(path, "record of a compression", cure):
        record = CompressionRecord(
            settings=content["settings"],
            baseline={int(batch): found for batch, found in content["baseline"].items()},
            levels=[_level(level) for level in content["levels"]],
            checked=content["checked"],
            finished=content["finished"],
        )
        if not isinstance(record.settings, dict):
            raise CorruptStateError(f"{path} is damaged: settings are not a mapping; {cure}")
    others = {
        name: (record.settings.get(name), settings.get(name))
        for name in {**record.settings, **settings}
        if record.settings.get(name) != settings.get(name)
    }
    if others and not record.levels:
        return CompressionRecord(settings)  # nothing is lost but a first look
    if others:
        told = ", ".join(
            f"{name} {old!r} instead of {new!r}" for name, (old, new) in others.items()
        )
        raise ConfigError(
            f"{folder} holds a compression with {told}. Give the same settings to resume it, or "
            "another folder"
        )
    return record


def _level(content: Mapping[str, Any]) -> Level:
    return Level(
        **{
            **content,
            "returns": tuple(content["returns"]),
            "change": Interval(**content["change"]),
        }
    )


def fingerprint(model: BaseAlgorithm) -> str:
    """Return a hash of a model's policy and step count."""
    digest = hashlib.sha256(f"{type(model).__name__} {model.num_timesteps}".encode())
    for name, tensor in sorted(unwrapped(model.policy).state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().numpy().tobytes())
    return digest.hexdigest()[:16]
