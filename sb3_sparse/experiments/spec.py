"""A study's YAML file, read and checked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, fields
from itertools import product
from pathlib import Path
from typing import Any

from sb3_sparse.errors import ConfigError, did_you_mean
from sb3_sparse.experiments.cell import Cell
from sb3_sparse.experiments.measures import Measures
from sb3_sparse.sparsity.numeric import is_whole
from sb3_sparse.topology import method_named, method_names
from sb3_sparse.zoo.configs import read_yaml
from sb3_sparse.zoo.environments import package_names
from sb3_sparse.zoo.run import Run
from sb3_sparse.zoo.settings import Names, find_callback

SHIPPED = Path(__file__).parent / "studies"
SCALES = ("smoke", "small", "paper")
KEYS = {"title", "figures", "varies", "common", "runs", "scales", "measures", "trained"}
RUN_KEYS = {one.name for one in fields(Run)} - {"seed", "device", "entry"}
CHOSEN = ("sparsity", "match_params", "method", "distribution", "algo")
"""What a scale chooses among a block's own values."""
VARY, SEEDS, MEASURES, SCHEDULE = "vary", "seeds", "measures", "schedule"
PACKAGES = "gym_packages"


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
    :param merged: names of cells that the file has more than once; they are trained once
    """

    name: str
    scale: str
    title: str
    figures: tuple[str, ...]
    varies: str | None
    cells: tuple[Cell, ...]
    merged: tuple[str, ...] = ()

    @classmethod
    def read(cls, what: str, scale: str, gym_packages: Sequence[str] = ()) -> Study:
        """A shipped study, or one's own from a file.

        :param what: a name of :func:`study_names`, or the path of a YAML file (docs/studies.md)
        :param scale: which of its scales
        :param gym_packages: modules that register environments, beside those that the file names
        :raises ConfigError: if there is no such study or scale, or something is wrong with it
        """
        path = Path(what)
        if path.suffix not in (".yml", ".yaml"):
            path = SHIPPED / f"{what}.yml"
            if not path.is_file():
                raise ConfigError(
                    f"unknown study {what!r}{did_you_mean(what, study_names())}; allowed are "
                    f"{', '.join(study_names())}, or a file of your own, .yml (docs/studies.md)"
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
            near = did_you_mean(scale, map(str, scales)) if isinstance(scales, Mapping) else ""
            raise ConfigError(f"{path} has no scale {scale!r}{near}, only {known}")
        try:
            given = list(_cells(content, scales[scale] or {}, gym_packages))
            times = Counter(cell.address for cell in given)
        except ConfigError as error:
            raise ConfigError(f"{path}, scale {scale}: {error}") from error
        first = {cell.address: cell for cell in reversed(given)}
        cells = tuple(first[address] for address in times)
        merged = tuple(cell.name for cell in cells if times[cell.address] > 1)
        if not cells:
            raise ConfigError(
                f"{path} has no run at scale {scale}: its blocks and the scale have no method or "
                "sparsity in common, or runs is empty (docs/studies.md)"
            )
        title, varies = str(content["title"]), content.get("varies")
        _check_varies(varies, cells, path)
        return cls(path.stem, scale, title, tuple(figures), varies, cells, merged)

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
        nearest = did_you_mean(unknown[0], allowed)
        raise ConfigError(
            f"{where} has unknown keys {', '.join(unknown)}{nearest}; allowed are "
            f"{', '.join(sorted(allowed))}"
        )


def _cells(
    content: Mapping[str, Any], of_scale: Any, gym_packages: Sequence[str]
) -> Iterator[Cell]:
    """All cells of a scale as the file has them, first seeds first."""
    check_keys(of_scale, RUN_KEYS | {SEEDS, MEASURES, SCHEDULE, VARY}, "a scale")
    if not isinstance(content["runs"], list):
        raise ConfigError(f"runs must be a list of blocks, got {content['runs']!r}")
    scale = dict(of_scale)
    seeds = scale.pop(SEEDS, 1)
    if not is_whole(seeds) or seeds < 1:
        raise ConfigError(f"seeds must be a number, 1 or more, got {seeds!r}")
    measures = Measures.of(scale.pop(MEASURES, content.get(MEASURES, {})))
    schedule = scale.pop(SCHEDULE, {})
    if not isinstance(schedule, Mapping):
        raise ConfigError(f"schedule must be a mapping, got {schedule!r}")
    trained = content.get("trained", True)
    if not isinstance(trained, bool):
        raise ConfigError(f"trained must be true or false, got {trained!r}")
    _check_schedule(schedule)
    blocks = [_block(content.get("common", {}), block, {}) for block in content["runs"]]
    _check_choices(blocks, scale)
    runs = [
        arguments
        for block in content["runs"]
        for given in _grid(_block(content.get("common", {}), block, scale))
        for known in [package_names(given.get(PACKAGES))]
        for whole in [{**given, PACKAGES: (*known, *gym_packages)}]
        for arguments in [_with_schedule(whole, schedule)]
    ]
    for seed in range(seeds):
        for arguments in runs:
            cell = Cell(Run(**arguments, seed=seed), measures, trained)
            measures.check(cell.run.algorithm)
            yield cell


def _check_varies(varies: Any, cells: Sequence[Cell], path: Path) -> None:
    if varies is None:
        return
    known: set[str] = set()
    for algorithm in {cell.run.algorithm for cell in cells}:
        names = Names.of(algorithm)
        known |= names.algorithm | names.policy | names.schedule
    if not isinstance(varies, str) or varies not in known:
        raise ConfigError(
            f"{path}: varies must be the name of a setting, e.g. batch_size, got {varies!r}"
            f"{did_you_mean(varies, known)}"
        )


def _check_schedule(schedule: Mapping[str, Any]) -> None:
    known = {name for method in method_names() for name in method_named(method).options}
    for name in schedule:
        if name not in known:
            raise ConfigError(
                f"schedule has {name!r}, which no method takes{did_you_mean(name, known)}; allowed "
                f"are {', '.join(sorted(known))}"
            )


def _check_choices(blocks: Sequence[Mapping[str, Any]], scale: Mapping[str, Any]) -> None:
    """Refuse what a scale chooses and no block has: it would drop runs without a word.

    :param blocks: as they stand, without the scale
    """
    varied = scale.get(VARY, {})
    check_lists(varied)
    chosen = {key: (scale[key], [one.get(key) for one in blocks]) for key in CHOSEN if key in scale}
    for key, values in varied.items():
        chosen[f"{VARY}: {key}"] = (values, [one.get(VARY, {}).get(key) for one in blocks])
    for key, (wanted, given) in chosen.items():
        known = [value for values in given if values is not None for value in _as_list(values)]
        if not known:
            raise ConfigError(f"the scale chooses {key}, which no block has; put it into a block")
        for value in [] if key.startswith(VARY) else _as_list(wanted):
            if value not in known:
                allowed = ", ".join(dict.fromkeys(map(repr, known)))
                raise ConfigError(
                    f"the scale chooses {key}: {value!r}, which no block has"
                    f"{did_you_mean(value, map(str, known))}; their values are {allowed}"
                )


def _as_list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


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
    check_lists(made.get(VARY, {}))
    made["hyperparams"] = {
        name: value
        for part in (common, block, scale)
        for name, value in (part.get("hyperparams") or {}).items()
    }
    for key, value in scale.items():
        if key == VARY:
            known = made.get(VARY, {})
            made[VARY] = {**known, **{name: value[name] for name in known if name in value}}
        elif key in CHOSEN:
            made[key] = _kept(made[key], value) if key in made else None
        elif key != "hyperparams":
            made[key] = value
    return {key: value for key, value in made.items() if value is not None}


def _kept(of_block: Any, of_scale: Any) -> Any:
    """What a scale leaves of a block's values: those that both have."""
    wanted = _as_list(of_scale)
    return [value for value in _as_list(of_block) if value in wanted]


def _grid(block: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Every combination of the lists in a block, and of what it varies."""
    varied = block.pop(VARY, {})
    hyperparams = block.pop("hyperparams", {})
    lists = {key: [value] if key == PACKAGES else _as_list(value) for key, value in block.items()}
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
