"""The definition of a search: stored with it when it is made, compared when it is joined."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from typing import Any

from sb3_sparse.errors import ConfigError
from sb3_sparse.tuning.backend import optuna
from sb3_sparse.tuning.objective import check_seeds, planned_evaluations
from sb3_sparse.tuning.samplers import pruner_of, sampler_of
from sb3_sparse.tuning.spaces import Space, check_space, one_of_each, with_values
from sb3_sparse.zoo.folder import env_name
from sb3_sparse.zoo.spec import RunSpec

DEFAULT_TRIALS = 100
NOT_COMPARED = ("run.entry",)  # the config's file; its content is compared as settings


@dataclass(frozen=True)
class Definition:
    """What is tuned, and how.

    :param run: what is trained; its seed is the first of every trial, and the sampler's
    :param space: what is searched
    :param seeds: runs per trial
    :param sampler: ``"grid"``, ``"tpe"`` or ``"random"``
    :param pruner: ``"none"``, ``"median"``, ``"halving"`` or ``"hyperband"``
    :raises ConfigError: if these do not fit together
    """

    run: RunSpec
    space: Space
    seeds: int
    sampler: str
    pruner: str

    def __post_init__(self) -> None:
        check_seeds(self.seeds)
        check_space(self.space, self.run)
        self.make_sampler()
        self.make_pruner()

    @property
    def method(self) -> str:
        """The method or preset that is tuned."""
        return self.run.name_of(self.run.settings())

    @property
    def default_name(self) -> str:
        """The search's name if the user gives none."""
        sparsity = self.run.settings().policy_kwargs["sparsity"]
        shares = sparsity.values() if isinstance(sparsity, Mapping) else [sparsity]
        method = self.method.replace(", ", "-").replace("=", "-")
        parts = [self.run.algo, env_name(self.run.env_id), method]
        searched = "sparsity" in one_of_each(self.space)
        if self.method != "dense" and not searched:
            parts += [f"{share:g}" for share in shares]
        return "_".join([*parts, self.space.name])

    def trials(self, wanted: int | None) -> int:
        """Return the number of trials.

        :param wanted: None: every cell of a grid, else 100
        :raises ConfigError: for fewer than 1, or more than a grid has cells
        """
        grid = self.space.grid if self.sampler == "grid" else None
        cells = prod(len(choices) for choices in grid.values()) if grid else None
        if wanted is None:
            return cells or DEFAULT_TRIALS
        if wanted < 1 or (cells is not None and wanted > cells):
            most = f"at most {cells}, the cells of the grid" if cells else "as many as you like"
            raise ConfigError(f"trials must be 1 or more, and {most}; got {wanted}")
        return wanted

    def ticket(self, number: int) -> dict[str, Any]:
        """Return the system attributes of a waiting trial, as Optuna's samplers read them."""
        if self.sampler != "grid":
            return {}
        return {"grid_id": number, "search_space": self.space.grid}

    def make_sampler(self) -> optuna.samplers.BaseSampler:
        """Make the search's sampler."""
        return sampler_of(self.sampler, self.space, self.run.seed)

    def make_pruner(self) -> optuna.pruners.BasePruner:
        """Make the search's pruner."""
        return pruner_of(self.pruner, planned_evaluations(self.run) * self.seeds)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, from which :meth:`from_dict` makes the same definition.

        The settings among them serve the comparison only. They hold one sample of the space in
        place of what is searched, which may change in the config, e.g. when the best values are
        written into it.
        """
        return {
            "run": self.run.as_dict(),
            "space": self.space.as_dict(),
            "seeds": self.seeds,
            "sampler": self.sampler,
            "pruner": self.pruner,
            "settings": with_values(self.run, one_of_each(self.space)).settings().as_dict(),
            "evaluation": self.run.evaluation(),
        }

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> Definition:
        """Make the definition that :meth:`as_dict` described."""
        return Definition(
            RunSpec(**values["run"]),
            Space.from_dict(values["space"]),
            values["seeds"],
            values["sampler"],
            values["pruner"],
        )


def differences(ours: Mapping[str, Any], theirs: Mapping[str, Any], path: str = "") -> list[str]:
    """Describe where two definitions differ."""
    found = []
    for name in sorted(ours.keys() | theirs.keys()):
        here, there = ours.get(name), theirs.get(name)
        if here == there or f"{path}{name}" in NOT_COMPARED:
            continue
        if isinstance(here, Mapping) and isinstance(there, Mapping):
            found += differences(here, there, f"{path}{name}.")
        else:
            found.append(f"{path}{name} is {there!r} there and {here!r} now")
    return found
