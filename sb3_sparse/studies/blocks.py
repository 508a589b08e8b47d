"""Expands the blocks of a study's YAML file into runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import fields
from itertools import product
from pathlib import Path
from typing import Any

from sb3_sparse.errors import ConfigError, did_you_mean
from sb3_sparse.zoo.configs import read_yaml
from sb3_sparse.zoo.spec import RunSpec

SHIPPED = Path(__file__).parent / "shipped"
SCALES = ("smoke", "small", "medium", "paper")
"""Scales of shipped studies; only some studies have ``medium``."""
REFERENCES = "reference_returns"
KEYS = {
    "title", "figures", "findings", "varies", "common", "runs", "scales", "measures", "trained",
    REFERENCES,
}  # fmt: skip
RUN_KEYS = {one.name for one in fields(RunSpec)} - {"seed", "device", "entry"}
CHOSEN = ("sparsity", "match_params", "method", "distribution", "algo")
"""Keys whose values a scale selects from a block's."""
VARY, SEEDS, MEASURES, SCHEDULE = "vary", "seeds", "measures", "schedule"
PACKAGES = "gym_packages"


def study_names() -> list[str]:
    """Return the names of the studies that come with the package."""
    return sorted(path.stem for path in SHIPPED.glob("*.yml"))


def path_of(what: str) -> Path:
    """Return the file of a study.

    :raises ConfigError: if there is no such study
    """
    path = Path(what)
    if path.suffix not in (".yml", ".yaml"):
        path = SHIPPED / f"{what}.yml"
        if not path.is_file():
            raise ConfigError(
                f"unknown study {what!r}{did_you_mean(what, study_names())}; allowed are "
                f"{', '.join(study_names())}, or your own .yml file (docs/studies.md)"
            )
    return path


def planned_runs(name: str) -> dict[str, int]:
    """Count the runs of a shipped study at each scale, without reading their settings.

    :param name: one of :func:`study_names`
    """
    content = read_yaml(path_of(name), "title, figures, runs and scales")
    return {
        scale: int((of_scale or {}).get(SEEDS, 1)) * len(planned_arguments(content, of_scale or {}))
        for scale, of_scale in content["scales"].items()
    }


def title_of(name: str) -> str:
    """Return the title of a shipped study."""
    return str(read_yaml(path_of(name), "title, figures, runs and scales")["title"])


def planned_arguments(content: Mapping[str, Any], scale: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the arguments of each run of one seed."""
    own = {key: value for key, value in scale.items() if key not in (SEEDS, MEASURES, SCHEDULE)}
    common = content.get("common", {})
    return [one for block in content["runs"] for one in _grid(block_of(common, block, own))]


def check_keys(given: Any, allowed: set[str], where: str) -> None:
    """Reject anything but a mapping with known keys.

    :raises ConfigError: naming the unknown keys and those that are allowed
    """
    if not isinstance(given, Mapping):
        raise ConfigError(f"{where} must be a mapping, got {given!r}")
    unknown = [str(key) for key in given if key not in allowed]
    if unknown:
        nearest = did_you_mean(unknown[0], allowed)
        raise ConfigError(
            f"{where} has unknown keys {', '.join(unknown)}{nearest}; allowed are "
            f"{', '.join(sorted(allowed))}"
        )


def block_of(common: Any, block: Any, scale: Mapping[str, Any]) -> dict[str, Any]:
    """Apply a scale to a block of runs.

    ``hyperparams`` are merged. A scale's sparsities, methods and varied hyperparameters select from
    those of blocks that set them; its other keys apply to every block.
    """
    for given, where in ((common, "common"), (block, "a block of runs")):
        check_keys(given, RUN_KEYS | {VARY}, where)
    for part in (common, block, scale):
        if not isinstance(part.get("hyperparams") or {}, Mapping):
            raise ConfigError(
                f"hyperparams must be a mapping, e.g. gamma: 0.98, got {part['hyperparams']!r}"
            )
    made: dict[str, Any] = deepcopy({**common, **block})
    check_lists(made.get(VARY, {}))
    made["hyperparams"] = {
        name: value
        for part in (common, block, scale)
        for name, value in (part.get("hyperparams") or {}).items()
    }
    for key, value in scale.items():
        if key == VARY:
            made[VARY] = {
                name: _kept(values, value[name]) if name in value else values
                for name, values in made.get(VARY, {}).items()
            }
        elif key in CHOSEN:
            made[key] = _kept(made[key], value) if key in made else None
        elif key != "hyperparams":
            made[key] = value
    return {key: value for key, value in made.items() if value is not None}


def _kept(of_block: Any, of_scale: Any) -> Any:
    """Return the values of a block that the scale has too."""
    wanted = as_list(of_scale)
    return [value for value in as_list(of_block) if value in wanted]


def _grid(block: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield every combination of the lists in a block and of the hyperparameters it varies."""
    varied = block.pop(VARY, {})
    hyperparams = block.pop("hyperparams", {})
    lists = {key: [value] if key == PACKAGES else as_list(value) for key, value in block.items()}
    for values in product(*lists.values()):
        for chosen in product(*varied.values()):
            yield {
                **dict(zip(lists, values, strict=True)),
                "hyperparams": {**hyperparams, **dict(zip(varied, chosen, strict=True))},
            }


def as_list(value: Any) -> list[Any]:
    """Return a list as it is, and any other value in a list."""
    return value if isinstance(value, list) else [value]


def check_lists(varied: Any) -> None:
    """Reject a ``vary`` that does not map names to lists.

    :raises ConfigError: naming the value and an example
    """
    if not isinstance(varied, Mapping) or not all(
        isinstance(values, list) and values for values in varied.values()
    ):
        raise ConfigError(
            f"vary must map hyperparameters to lists, e.g. weight_decay: [0.0, 1.0e-4], got "
            f"{varied!r}"
        )
