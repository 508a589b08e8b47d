"""A run as its folder or archive describes it, and runs that are left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_sparse.report.measured import Rows
from sb3_sparse.report.methods import DENSE, EQUAL
from sb3_sparse.zoo.clock import computed_in
from sb3_sparse.zoo.environments import suite_of
from sb3_sparse.zoo.record import Record, Status
from sb3_sparse.zoo.results import score_of
from sb3_sparse.zoo.settings import Settings

Array = npt.NDArray[np.float64]
WIDTHS = ("net_arch", "features_extractor_class", "features_extractor_kwargs")
"""Settings that match_params changes; those that were asked for distinguish variants."""


@dataclass(frozen=True)
class LeftOut:
    """A run, or a file of one, that is not in the report.

    :param folder: the run's folder
    :param reason: why it is left out
    :param diverged: whether the run's training ended in NaN

    Example::

        from sb3_sparse.report import read_runs

        runs, left_out = read_runs(["logs/dqn/CartPole-v1_1"])
        for one in left_out:
            print(one.folder, one.reason)
    """

    folder: Path
    reason: str
    diverged: bool = False


@dataclass(frozen=True, eq=False)
class RunData:
    """A run, as its folder describes it.

    :param folder: where it was read
    :param record: content of ``sparsity.json``
    :param timesteps: environment steps of each evaluation, shape ``[T]``; empty if never trained
    :param returns: mean episode return of each evaluation, shape ``[T]``
    :param measured: rows of the files of measurements that exist, by file name

    Example::

        from sb3_sparse.report import read_runs
        from sb3_sparse.zoo import RunSpec, train

        train(RunSpec("dqn", "CartPole-v1", method="static", n_timesteps=200, eval_freq=100))
        (run,), left_out = read_runs(["logs/dqn/CartPole-v1_1"])
        print(run.env_id, run.label, run.level, run.score)
    """

    folder: Path
    record: Record
    timesteps: Array
    returns: Array
    measured: Mapping[str, Rows] = field(default_factory=dict)

    @property
    def trained(self) -> bool:
        """Whether it was trained, not only counted."""
        return self.record.status is Status.FINISHED

    @property
    def algo(self) -> str:
        return str(self.record["run"]["algo"])

    @property
    def env_id(self) -> str:
        return str(self.record["run"]["env_id"])

    @property
    def seed(self) -> int:
        return int(self.record["run"]["seed"])

    @property
    def settings(self) -> Settings:
        return self.record.settings

    @property
    def steps(self) -> int:
        """The number of environment steps that its settings ask for."""
        return int(self.settings.get("n_timesteps", 0))

    @cached_property
    def family(self) -> str:
        """Algorithm, architecture and suite; runs of one family are compared."""
        extractor = str(self.settings.policy_kwargs.get("features_extractor_class", ""))
        resnet = " with the Impala ResNet" if "impala" in extractor.lower() else ""
        simba = " with SimBa" if "Simba" in str(self.settings.get("policy")) else ""
        return f"{self.algo.upper()}{resnet}{simba} on {suite_of(self.env_id)}"

    @cached_property
    def label(self) -> str:
        """The method; a dense network that matches a sparse one has a label of its own."""
        method = str(self.record["method"])
        small = self.record["run"].get("match_params") is not None
        return EQUAL if method == DENSE and small else method

    @cached_property
    def level(self) -> float:
        """The sparsity; for a dense network that matches a sparse one, the sparsity of that one."""
        matched = self.record["run"].get("match_params")
        if matched is not None:
            return float(matched)
        if self.label == DENSE:
            return 0.0
        asked = self.settings.policy_kwargs.get("sparsity")
        if isinstance(asked, (int, float)):
            return float(asked)
        return round(float(self.record["total"]["sparsity"]), 3)

    @cached_property
    def score(self) -> float:
        """The mean over the last 10 % of the evaluations."""
        return score_of([float(value) for value in self.returns])

    @property
    def parameters(self) -> int:
        """The number of active weights and biases."""
        return int(self.record["total"]["parameters"])

    @property
    def connections(self) -> int:
        """The number of active weights."""
        return sum(int(layer["nnz"]) for layer in self.layers)

    @property
    def flops(self) -> int:
        """The FLOPs of a forward pass of all networks, for one observation."""
        return int(self.record["total"]["flops"])

    @property
    def dense_flops(self) -> int:
        """The FLOPs of the same pass if every connection were active."""
        return int(self.record["total"]["dense_flops"])

    @property
    def seconds(self) -> float | None:
        """The seconds that it computed, without evaluations; None if its record lacks them."""
        return computed_in(self.record)

    @property
    def layers(self) -> list[dict[str, Any]]:
        return list(self.record["layers"])

    @cached_property
    def actor_share(self) -> float | None:
        """The actor's fraction of all active weights; None without an actor."""
        counts: dict[str, int] = {}
        for layer in self.layers:
            counts[layer["network"]] = counts.get(layer["network"], 0) + int(layer["nnz"])
        total = sum(counts.values())
        return counts["actor"] / total if len(counts) > 1 and counts.get("actor") else None

    @cached_property
    def asked(self) -> Settings:
        """Its settings, with the widths that were asked for in place of those of a match.

        Widths that the config gave are left out there.
        """
        if self.label != EQUAL:
            return self.settings
        changed = self.record["run"].get("hyperparams") or {}
        kwargs = {n: value for n, value in self.settings.policy_kwargs.items() if n not in WIDTHS}
        kwargs.update({name: changed[name] for name in WIDTHS if name in changed})
        return self.settings.replaced(policy_kwargs=kwargs)

    def variant(self, *without: str) -> str:
        """Return its settings without method and sparsity, as a text to compare.

        :param without: names of more settings that may differ
        """
        return self.asked.variant(without)

    @property
    def changes(self) -> int:
        """The number of settings of its config that the run changes."""
        run = self.record["run"]
        others = sum(run.get(name) is not None for name in ("distribution", "conf_file", "entry"))
        return len(run.get("hyperparams") or {}) + others
