"""Reads and checks a study's YAML file."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sb3_sparse.errors import ConfigError, did_you_mean
from sb3_sparse.policies.arguments import arguments_of
from sb3_sparse.sparsity.numeric import is_number, is_whole
from sb3_sparse.studies.blocks import (
    CHOSEN,
    KEYS,
    MEASURES,
    PACKAGES,
    REFERENCES,
    RUN_KEYS,
    SCHEDULE,
    SEEDS,
    VARY,
    as_list,
    block_of,
    check_keys,
    check_lists,
    path_of,
    planned_arguments,
)
from sb3_sparse.studies.cell import Cell
from sb3_sparse.studies.measures import Measures
from sb3_sparse.topology import method_named, method_names
from sb3_sparse.zoo.configs import read_yaml
from sb3_sparse.zoo.environments import package_names, plain_id
from sb3_sparse.zoo.names import Names
from sb3_sparse.zoo.spec import RunSpec


@dataclass(frozen=True)
class Study:
    """A study at one scale: the cells to train and the figures to draw.

    Example::

        from sb3_sparse.studies import Study

        study = Study.read("classic_control", "smoke")
        print(study.title, len(study.cells), study.cells[0].name)

    :param name: name of the file
    :param scale: one of the file's scales, e.g. ``"small"``
    :param title: title of the report
    :param figures: names of figures of :mod:`sb3_sparse.report`
    :param varies: the setting that the study varies; None: only method and sparsity
    :param cells: the cells to train, first seeds first
    :param findings: keys of the findings of the paper that it tests; None: all on which it has data
    :param references: the returns that become 0 and 1 on its page, by environment
    :param merged: names of cells that the file has more than once; they are trained once
    """

    name: str
    scale: str
    title: str
    figures: tuple[str, ...]
    varies: str | None
    cells: tuple[Cell, ...]
    merged: tuple[str, ...] = ()
    findings: tuple[str, ...] | None = None
    references: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def read(cls, what: str, scale: str, gym_packages: Sequence[str] = ()) -> Study:
        """Read a shipped study, or your own from a file.

        :param what: a name of :func:`study_names`, or the path of a YAML file (docs/studies.md)
        :param scale: one of its scales
        :param gym_packages: further modules that register environments
        :raises ConfigError: if there is no such study or scale, or if it is invalid
        """
        path = path_of(what)
        content = read_yaml(path, "title, figures, runs and scales")
        check_keys(content, KEYS, str(path))
        for key in ("title", "figures", "runs", "scales"):
            if key not in content:
                raise ConfigError(f"{path} lacks {key!r} (docs/studies.md)")
        figures, scales = content["figures"], content["scales"]
        if not figures or not isinstance(figures, list) or set(map(type, figures)) != {str}:
            raise ConfigError(f"{path}: figures must be a list of names, got {figures!r}")
        findings = content.get("findings")
        if findings is not None and (
            not isinstance(findings, list) or not all(isinstance(one, str) for one in findings)
        ):
            raise ConfigError(f"{path}: findings must be a list of keys, got {findings!r}")
        if "sensitivity" in figures and "varies" not in content:
            raise ConfigError(f"{path}: the figure sensitivity needs varies, a setting's name")
        if not isinstance(scales, Mapping) or scale not in scales:
            known = isinstance(scales, Mapping) and ", ".join(scales) or repr(scales)
            near = did_you_mean(scale, map(str, scales)) if isinstance(scales, Mapping) else ""
            raise ConfigError(f"{path} has no scale {scale!r}{near}, only {known}")
        try:
            given = _cells(content, scales[scale] or {}, gym_packages)
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
        tested = None if findings is None else tuple(findings)
        returns = _references(content.get(REFERENCES, {}), path)
        return cls(path.stem, scale, title, tuple(figures), varies, cells, merged, tested, returns)

    @property
    def report_folder(self) -> Path:
        """The folder of its report, relative to the store."""
        return Path(self.name) / self.scale


def _cells(content: Mapping[str, Any], of_scale: Any, gym_packages: Sequence[str]) -> list[Cell]:
    """Return all cells of a scale as the file has them, first seeds first."""
    check_keys(of_scale, RUN_KEYS | {SEEDS, MEASURES, SCHEDULE, VARY}, "a scale")
    if not isinstance(content["runs"], list):
        raise ConfigError(f"runs must be a list of blocks, got {content['runs']!r}")
    scale = of_scale
    seeds = scale.get(SEEDS, 1)
    if not is_whole(seeds) or seeds < 1:
        raise ConfigError(f"seeds must be a number, 1 or more, got {seeds!r}")
    measures = Measures.of(scale.get(MEASURES, content.get(MEASURES, {})))
    schedule = scale.get(SCHEDULE, {})
    if not isinstance(schedule, Mapping):
        raise ConfigError(f"schedule must be a mapping, got {schedule!r}")
    trained = content.get("trained", True)
    if not isinstance(trained, bool):
        raise ConfigError(f"trained must be true or false, got {trained!r}")
    _check_schedule(schedule)
    blocks = [block_of(content.get("common", {}), block, {}) for block in content["runs"]]
    _check_choices(blocks, scale)
    runs = [
        arguments
        for given in planned_arguments(content, scale)
        for known in [package_names(given.get(PACKAGES))]
        for whole in [{**given, PACKAGES: (*known, *gym_packages)}]
        for arguments in [_with_schedule(whole, schedule)]
    ]
    cells = [Cell(RunSpec(**arguments), measures, trained) for arguments in runs]
    for cell in cells:
        measures.check(cell.run.algorithm)
    return [cell.with_seed(seed) for seed in range(seeds) for cell in cells]


def _check_varies(varies: Any, cells: Sequence[Cell], path: Path) -> None:
    if varies is None:
        return
    known: set[str] = set()
    for algorithm in {cell.run.algorithm for cell in cells}:
        known |= Names.of(algorithm).all
    if not isinstance(varies, str) or varies not in known:
        raise ConfigError(
            f"{path}: varies must be the name of a setting, e.g. batch_size, got {varies!r}"
            f"{did_you_mean(varies, known)}"
        )


def _references(given: Any, path: Path) -> dict[str, tuple[float, float]]:
    """Read the returns that become 0 and 1, by environment."""
    if not isinstance(given, Mapping):
        raise ConfigError(f"{path}: {REFERENCES} must map environments to pairs, got {given!r}")
    found = {}
    for name, pair in given.items():
        env_id, _ = plain_id(str(name))
        if (
            not isinstance(pair, list)
            or len(pair) != 2
            or not all(is_number(one) and math.isfinite(one) for one in pair)
            or pair[0] >= pair[1]
        ):
            raise ConfigError(
                f"{path}: {REFERENCES} of {name} must be two returns, of which the second is the "
                f"greater, e.g. [-500, -60], got {pair!r}"
            )
        found[env_id] = (float(pair[0]), float(pair[1]))
    return found


def _check_schedule(schedule: Mapping[str, Any]) -> None:
    known = {name for method in method_names() for name in method_named(method).options}
    known |= _of_robust_value()
    for name in schedule:
        if name not in known:
            raise ConfigError(
                f"schedule has {name!r}, which no method takes{did_you_mean(name, known)}; allowed "
                f"are {', '.join(sorted(known))}"
            )


def _of_robust_value() -> frozenset[str]:
    from sb3_sparse.callbacks import RobustValueCallback  # which imports torch

    return arguments_of(RobustValueCallback) - {"verbose"}


def _check_choices(blocks: Sequence[Mapping[str, Any]], scale: Mapping[str, Any]) -> None:
    """Reject a choice of a scale that no block has: it would silently drop runs.

    :param blocks: the blocks without the scale
    """
    varied = scale.get(VARY, {})
    check_lists(varied)
    chosen = {key: (scale[key], [one.get(key) for one in blocks]) for key in CHOSEN if key in scale}
    for key, values in varied.items():
        chosen[f"{VARY}: {key}"] = (values, [one.get(VARY, {}).get(key) for one in blocks])
    for key, (wanted, given) in chosen.items():
        known = [value for values in given if values is not None for value in as_list(values)]
        if not known:
            raise ConfigError(f"the scale chooses {key}, which no block has; put it into a block")
        for value in as_list(wanted):
            if value not in known:
                allowed = ", ".join(dict.fromkeys(map(repr, known)))
                raise ConfigError(
                    f"the scale chooses {key}: {value!r}, which no block has"
                    f"{did_you_mean(str(value), map(str, known))}; their values are {allowed}"
                )


def _with_schedule(arguments: dict[str, Any], schedule: Mapping[str, Any]) -> dict[str, Any]:
    """Add the entries of a scale's ``schedule`` that the callbacks take: none for static masks."""
    if not schedule:
        return arguments
    run = RunSpec(**arguments)
    settings = run.settings()
    options: frozenset[str] = frozenset()
    if settings.methods is not None:
        options |= settings.methods.options
    if settings.robust_value is not None:
        options |= _of_robust_value()
    if not options:
        return arguments
    taken = {name: value for name, value in schedule.items() if name in options}
    return {**arguments, "hyperparams": {**taken, **run.hyperparams}}
