"""The runs of a report, and which of them compare methods."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from sb3_sparse.errors import SparsityError
from sb3_sparse.pages.numbers import counted
from sb3_sparse.report.data import RunData
from sb3_sparse.report.methods import DENSE, in_order
from sb3_sparse.report.normalisation import Normaliser, References
from sb3_sparse.zoo.spec import algorithms

Cell = tuple[str, str, str, float]


class NotEnoughData(SparsityError):
    """A figure cannot be drawn from these runs; the message says why."""


@dataclass(frozen=True)
class Results:
    """The runs of a report, grouped, and with their scores on one scale.

    :param runs: as :func:`read_runs` returns them
    :param varies: name of the setting that was varied, for the figure ``"sensitivity"``
    :param findings: keys of the findings of the paper to judge; None for all
    :param references: the returns that become 0 and 1 by task; the others have scales of their own

    Example::

        from sb3_sparse.report import Results, judge, read_runs

        runs, left_out = read_runs(["logs/dqn/CartPole-v1_1", "logs/dqn/CartPole-v1_2"])
        results = Results(tuple(runs))
        for verdict in judge(results):
            print(verdict.finding.text, verdict.verdict, verdict.remark)
    """

    runs: tuple[RunData, ...]
    varies: str | None = None
    findings: tuple[str, ...] | None = None
    references: References = field(default_factory=dict, hash=False)

    @cached_property
    def trained(self) -> list[RunData]:
        """All runs that were trained, with any settings."""
        return [run for run in self.runs if run.trained]

    @cached_property
    def _chosen(self) -> tuple[list[RunData], list[str]]:
        return choose(self.trained)

    @property
    def main(self) -> list[RunData]:
        """The runs that compare methods: one variant of settings for each cell."""
        return self._chosen[0]

    @property
    def remarks(self) -> list[str]:
        """Remarks on the variants of settings that are not among them."""
        return self._chosen[1]

    @cached_property
    def normaliser(self) -> Normaliser:
        """The scales; of the runs, only the dense ones among the main runs can set one."""
        return Normaliser(self.main, self.references)

    def families(self) -> list[str]:
        """Return the families (algorithm, architecture and suite) of the trained runs."""
        return sorted({run.family for run in self.trained})

    def levels(self, family: str) -> list[float]:
        """Return the sparsities at which methods are compared, ascending."""
        return sorted({r.level for r in self.main if r.family == family and r.label != DENSE})

    def envs(self, family: str) -> list[str]:
        """Return the tasks of a family."""
        return sorted({run.env_id for run in self.trained if run.family == family})

    def labels(self, family: str, level: float | None = None) -> list[str]:
        """Return the methods at a sparsity, or at any; dense of full size belongs to each."""
        return in_order(
            {
                run.label
                for run in self.main
                if run.family == family and (level in (None, run.level) or run.label == DENSE)
            }
        )

    def cell(self, family: str, env_id: str, label: str, level: float) -> list[RunData]:
        """Return the runs to average, by ascending seed."""
        level = 0.0 if label == DENSE else level
        return self._cells.get((family, env_id, label, level), [])

    @cached_property
    def _cells(self) -> dict[Cell, list[RunData]]:
        return grouped(self.main, cell_of)

    def setting(self, run: RunData, name: str) -> object:
        """Return a setting's value in a run, or its default."""
        return run.settings.value(name, algorithms().get(run.algo))


def cell_of(run: RunData) -> Cell:
    """Return what runs that differ only in settings and seed have in common."""
    return run.family, run.env_id, run.label, run.level


def grouped(runs: Iterable[RunData], key: Callable[[RunData], Cell]) -> dict[Cell, list[RunData]]:
    """Group runs by a key, in ascending order of seeds."""
    found: dict[Cell, list[RunData]] = defaultdict(list)
    for run in sorted(runs, key=lambda run: run.seed):
        found[key(run)].append(run)
    return dict(found)


def choose(runs: Sequence[RunData]) -> tuple[list[RunData], list[str]]:
    """Choose one variant of settings for each cell, so that no two settings are averaged.

    It chooses the variant that changes the fewest settings of its config; among equals the one with
    the most seeds; then the first in the order of their texts.

    :return: the runs of the chosen variants, and a remark for each cell that has others
    """
    main: list[RunData] = []
    remarks = []
    for cell, members in sorted(grouped(runs, cell_of).items()):
        variants: dict[str, list[RunData]] = defaultdict(list)
        for run in members:
            variants[run.variant()].append(run)
        chosen = min(
            variants, key=lambda text: (_changed(variants[text]), -len(variants[text]), text)
        )
        main += variants[chosen]
        if len(variants) > 1:
            others = len(members) - len(variants[chosen])
            family, env_id, label, level = cell
            remarks.append(
                f"{family}, {env_id}, {label} at {level:g}: {len(variants)} variants of settings; "
                f"methods are compared by {counted(len(variants[chosen]), 'run')} of one, "
                f"{counted(others, 'run')} of the others are in the tables and in figures about "
                "settings only"
            )
    return main, remarks


def _changed(runs: Sequence[RunData]) -> int:
    return min(run.changes for run in runs)
