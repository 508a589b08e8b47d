"""All runs of a report, and which of them methods are compared by."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

from sb3_sparse.errors import SparsityError
from sb3_sparse.report.data import RunData
from sb3_sparse.report.methods import DENSE, in_order
from sb3_sparse.report.normalisation import Normaliser
from sb3_sparse.report.settings import overrides_of, setting_of

Cell = tuple[str, str, str, float]


class NotEnoughData(SparsityError):
    """A figure cannot be drawn from these runs; the message says why."""


@dataclass(frozen=True)
class Results:
    """Runs with what is derived of them.

    :param runs: all that were read
    :param varies: name of the setting that was varied, for the figure of sensitivity
    """

    runs: tuple[RunData, ...]
    varies: str | None = None

    @cached_property
    def trained(self) -> list[RunData]:
        """All that were trained, whatever their settings."""
        return [run for run in self.runs if run.trained]

    @cached_property
    def _chosen(self) -> tuple[list[RunData], list[str]]:
        return choose(self.trained)

    @property
    def main(self) -> list[RunData]:
        """The runs that methods are compared by: one variant of settings for each cell."""
        return self._chosen[0]

    @property
    def remarks(self) -> list[str]:
        """Which variants of settings are not among them."""
        return self._chosen[1]

    @cached_property
    def normaliser(self) -> Normaliser:
        """Built of the main runs, so that another variant's dense runs set no scale."""
        return Normaliser(self.main)

    def families(self) -> list[str]:
        """Algorithm, architecture and suite of all trained runs."""
        return sorted({run.family for run in self.trained})

    def levels(self, family: str) -> list[float]:
        """Sparsities at which methods are compared, rising."""
        return sorted({r.level for r in self.main if r.family == family and r.label != DENSE})

    def envs(self, family: str) -> list[str]:
        """Tasks."""
        return sorted({run.env_id for run in self.trained if run.family == family})

    def labels(self, family: str, level: float | None = None) -> list[str]:
        """Methods at a sparsity or at any; the dense network of full size belongs to each."""
        return in_order(
            {
                run.label
                for run in self.main
                if run.family == family and (level in (None, run.level) or run.label == DENSE)
            }
        )

    def cell(self, family: str, env_id: str, label: str, level: float) -> list[RunData]:
        """Runs to be averaged, by rising seed."""
        level = 0.0 if label == DENSE else level
        return self._cells.get((family, env_id, label, level), [])

    @cached_property
    def _cells(self) -> dict[Cell, list[RunData]]:
        return grouped(self.main, cell_of)

    def setting(self, run: RunData, name: str) -> object:
        """A setting's value in a run, or its default."""
        return setting_of(run.algo, run.settings, name)


def cell_of(run: RunData) -> Cell:
    """What runs that differ in nothing but settings and seed have in common."""
    return run.family, run.env_id, run.label, run.level


def grouped(runs: Iterable[RunData], key: Callable[[RunData], Cell]) -> dict[Cell, list[RunData]]:
    """Runs by a key, by rising seed."""
    found: dict[Cell, list[RunData]] = defaultdict(list)
    for run in sorted(runs, key=lambda run: run.seed):
        found[key(run)].append(run)
    return dict(found)


def choose(runs: Sequence[RunData]) -> tuple[list[RunData], list[str]]:
    """One variant of settings for each cell, so that no two settings are averaged.

    That whose runs change the fewest settings of their config; among these that with most seeds;
    then the first in the order of their text.

    :return: its runs, and a remark for each cell that has other variants
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
                f"methods are compared by {len(variants[chosen])} run(s) of one, {others} "
                "run(s) of the others are in the tables and in figures about settings only"
            )
    return main, remarks


def _changed(runs: Sequence[RunData]) -> int:
    return min(overrides_of(run.record["run"]) for run in runs)
