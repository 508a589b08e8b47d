"""A study's YAML file, read and checked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, fields
from itertools import product
from pathlib import Path
from typing import Any

from sb3_sparse.callback import SparsityCallback
from sb3_sparse.errors import ConfigError
from sb3_sparse.experiments.cell import Cell
from sb3_sparse.experiments.measures import Measures
from sb3_sparse.topology import method_named
from sb3_sparse.zoo.configs import read_yaml
from sb3_sparse.zoo.run import Run
from sb3_sparse.zoo.settings import find_callback

SHIPPED = Path(__file__).parent / "studies"
SCALES = ("smoke", "small", "paper")
KEYS = {"title", "figures", "varies", "common", "runs", "scales", "measures", "trained"}
RUN_KEYS = {one.name for one in fields(Run)} - {"seed", "device", "entry"}
VARY, SEEDS, MEASURES, SCHEDULE = "vary", "seeds", "measures", "schedule"


def study_names() -> list[str]:
    """The names of the studies that come with the package."""
    return sorted(path.stem for path in SHIPPED.glob("*.yml"))


@dataclass(frozen=True)
class Study:
    """What is trained, at one scale, and what is drawn of it.

    :param name: of the file
    :param scale: ``"smoke"``, ``"small"`` or ``"paper"``
    :param title: for its report
    :param figures: names of figures, as :mod:`sb3_sparse.report` has them
    :param varies: the setting that the study varies; None: none but method and sparsity
    :param cells: what is trained, first seeds first
    """

    name: str
    scale: str
    title: str
    figures: tuple[str, ...]
    varies: str | None
    cells: tuple[Cell, ...]

    @classmethod
    def read(cls, what: str, scale: str) -> Study:
        """A shipped study, or one's own from a file.

        :param what: a name of :func:`study_names`, or the path of a YAML file (docs/studies.md)
        :param scale: which of its scales
        :raises ConfigError: if there is no such study or scale, or something is wrong with it
        """
        path = Path(what)
        if path.suffix not in (".yml", ".yaml"):
            path = SHIPPED / f"{what}.yml"
            if not path.is_file():
                raise ConfigError(
                    f"unknown study {what!r}; allowed are {', '.join(study_names())}, or a file "
                    "of your own, .yml (docs/studies.md)"
                )
        content = read_yaml(path, "title, figures, runs and scales")
        check_keys(content, KEYS, str(path))
        for key in ("title", "figures", "runs", "scales"):
            if key not in content:
                raise ConfigError(f"{path} lacks {key!r} (docs/studies.md)")
        figures, scales = content["figures"], content["scales"]
        if not figures or not isinstance(figures, list) or set(map(type, figures)) != {str}:
            raise ConfigError(f"{path}: figures must be a list of names, got {figures!r}")
        if "sensitivity" in figures and "varies" not in content:
            raise ConfigError(f"{path}: the figure sensitivity needs varies, a setting's name")
        if not isinstance(scales, Mapping) or scale not in scales:
            known = isinstance(scales, Mapping) and ", ".join(scales) or repr(scales)
            raise ConfigError(f"{path} has no scale {scale!r}, only {known}")
        try:
            cells = tuple(_cells(content, scales[scale] or {}))
        except ConfigError as error:
            raise ConfigError(f"{path}, scale {scale}: {error}") from error
        if not cells:
            raise ConfigError(
                f"{path} has no run at scale {scale}: its blocks and the scale have no method or "
                "sparsity in common, or runs is empty (docs/studies.md)"
            )
        title, varies = str(content["title"]), content.get("varies")
        return cls(path.stem, scale, title, tuple(figures), varies, cells)

    @property
    def report_folder(self) -> Path:
        """Where its report goes, below the store."""
        return Path(self.name) / self.scale


def check_keys(given: Any, allowed: set[str], where: str) -> None:
    """Refuse what is no mapping, and keys that mean nothing.

    :raises ConfigError: if so
    """
    if not isinstance(given, Mapping):
        raise ConfigError(f"{where} must be a mapping, got {given!r}")
    unknown = [str(key) for key in given if key not in allowed]
    if unknown:
        raise ConfigError(
            f"{where} has unknown keys {', '.join(unknown)}; allowed are "
            f"{', '.join(sorted(allowed))}"
        )


def _cells(content: Mapping[str, Any], of_scale: Any) -> Iterator[Cell]:
    """All cells of a scale, first seeds first, none twice."""
    check_keys(of_scale, RUN_KEYS | {SEEDS, MEASURES, SCHEDULE, VARY}, "a scale")
    if not isinstance(content["runs"], list):
        raise ConfigError(f"runs must be a list of blocks, got {content['runs']!r}")
    scale = dict(of_scale)
    seeds = scale.pop(SEEDS, 1)
    if isinstance(seeds, bool) or not isinstance(seeds, int) or seeds < 1:
        raise ConfigError(f"seeds must be a number, 1 or more, got {seeds!r}")
    measures = Measures.of(scale.pop(MEASURES, content.get(MEASURES, {})))
    schedule = scale.pop(SCHEDULE, {})
    if not isinstance(schedule, Mapping):
        raise ConfigError(f"schedule must be a mapping, got {schedule!r}")
    trained = content.get("trained", True)
    if not isinstance(trained, bool):
        raise ConfigError(f"trained must be true or false, got {trained!r}")
    runs = [
        arguments
        for block in content["runs"]
        for given in _grid(_block(content.get("common", {}), block, scale))
        for arguments in [_with_schedule(given, schedule)]
    ]
    seen: set[str] = set()
    for seed in range(seeds):
        for arguments in runs:
            cell = Cell(Run(**arguments, seed=seed), measures, trained)
            measures.check(cell.run.algorithm)
            if cell.address not in seen:
                seen.add(cell.address)
                callback = find_callback(cell.run.settings())
                if callback is not None:
                    SparsityCallback(**callback)  # refuses here what it would refuse in the run
                yield cell


def _with_schedule(arguments: dict[str, Any], schedule: Mapping[str, Any]) -> dict[str, Any]:
    """With what of a scale's ``schedule`` the method takes: nothing where masks stand still."""
    run = Run(**arguments)
    callback = find_callback(run.settings()) if schedule else None
    if callback is None:
        return arguments
    options = method_named(callback["method"]).options
    taken = {name: value for name, value in schedule.items() if name in options}
    return {**arguments, "hyperparams": {**taken, **run.hyperparams}}


def _block(common: Any, block: Any, scale: Mapping[str, Any]) -> dict[str, Any]:
    """A block of runs as a scale has it.

    ``hyperparams`` add up. What a scale says of sparsities, methods or what is varied goes to
    those blocks alone that speak of it; all else goes to every block.
    """
    for given, where in ((common, "common"), (block, "a block of runs")):
        check_keys(given, RUN_KEYS | {VARY}, where)
    for part in (common, block, scale):
        if not isinstance(part.get("hyperparams") or {}, Mapping):
            raise ConfigError(
                f"hyperparams must be a mapping, e.g. gamma: 0.98, got {part['hyperparams']!r}"
            )
    made: dict[str, Any] = deepcopy({**common, **block})
    made["hyperparams"] = {
        name: value
        for part in (common, block, scale)
        for name, value in (part.get("hyperparams") or {}).items()
    }
    for key, value in scale.items():
        if key == VARY:
            known = made.get(VARY, {})
            made[VARY] = {**known, **{name: value[name] for name in known if name in value}}
        elif key in ("sparsity", "match_params", "method", "distribution", "algo"):
            made[key] = _kept(made[key], value) if key in made else None
        elif key != "hyperparams":
            made[key] = value
    return {key: value for key, value in made.items() if value is not None}


def _kept(of_block: Any, of_scale: Any) -> Any:
    """What a scale leaves of a block's values: those that both have."""
    if not isinstance(of_block, list):
        return of_block if not isinstance(of_scale, list) or of_block in of_scale else []
    wanted = of_scale if isinstance(of_scale, list) else [of_scale]
    return [value for value in of_block if value in wanted]


def _grid(block: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Every combination of the lists in a block, and of what it varies."""
    varied = block.pop(VARY, {})
    check_lists(varied)
    hyperparams = block.pop("hyperparams", {})
    lists = {key: value if isinstance(value, list) else [value] for key, value in block.items()}
    for values in product(*lists.values()):
        for chosen in product(*varied.values()):
            yield {
                **dict(zip(lists, values, strict=True)),
                "hyperparams": {**hyperparams, **dict(zip(varied, chosen, strict=True))},
            }


def check_lists(varied: Any) -> None:
    """Refuse a ``vary`` that does not map names to lists.

    :raises ConfigError: if so
    """
    if not isinstance(varied, Mapping) or not all(
        isinstance(values, list) and values for values in varied.values()
    ):
        raise ConfigError(
            f"vary must map hyperparameters to lists, e.g. weight_decay: [0.0, 1.0e-4], got "
            f"{varied!r}"
        )
