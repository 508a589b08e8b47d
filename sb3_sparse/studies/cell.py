"""One cell of a study: a run, its measures, and a folder named by their content."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from sb3_sparse.studies.measures import Measures
from sb3_sparse.zoo.folder import RunFolder, env_name
from sb3_sparse.zoo.settings import Settings
from sb3_sparse.zoo.spec import RunSpec

RUNS = "runs"
DIGITS = 12


@dataclass(frozen=True)
class Cell:
    """A run with its measures. Studies that contain the same cell share it.

    :param run: the run to train
    :param measures: what is measured beside its evaluations
    :param trained: False: only build and count its networks
    """

    run: RunSpec
    measures: Measures = field(default_factory=Measures)
    trained: bool = True

    @cached_property
    def address(self) -> str:
        """A hash, 12 hexadecimal digits, of everything that determines the result.

        That is every setting after configs and overrides, the seed, the evaluations, and the
        measures during training; not the device, nor measures of the trained model, which may be
        added later.
        """
        content = {**self._content, "seed": self.run.seed}
        text = json.dumps(content, sort_keys=True, default=_plain)
        return hashlib.sha256(text.encode()).hexdigest()[:DIGITS]

    @cached_property
    def _content(self) -> dict[str, Any]:
        """What determines the result, but for the seed."""
        run = self.run
        content: dict[str, Any] = {
            "algo": run.algo,
            "env_id": run.env_id,
            "settings": self.settings.as_dict(),
            "evaluation": run.evaluation(),
            "match_params": run.match_params,
            "during": self.measures.during,
            "trained": self.trained,
        }
        if run.gym_packages:
            content["gym_packages"] = run.gym_packages
        return content

    @cached_property
    def settings(self) -> Settings:
        """The settings of its run."""
        return self.run.settings()

    def with_seed(self, seed: int) -> Cell:
        """Return the same cell with another seed, on which its settings do not depend."""
        other = replace(self, run=replace(self.run, seed=seed))
        # Fills the other's cached properties, so that it looks nothing up.
        vars(other).update(settings=self.settings, _content=self._content)
        return other

    def folder(self, store: Path) -> RunFolder:
        """Return the run's folder, ``<store>/runs/<algo>/<env>_<address>``."""
        name = f"{env_name(self.run.env_id)}_{self.address}"
        return RunFolder(store / RUNS / self.run.algo / name)

    def errors(self, store: Path) -> Path:
        """Return the file of tracebacks, which exists only if the cell failed."""
        return store / "failed" / f"{self.address}.txt"

    @property
    def name(self) -> str:
        """A short description of the cell."""
        run = self.run
        if run.match_params is not None:
            how = f"dense as {run.match_params:.0%}"
        else:
            share = "" if run.sparsity is None else f" {run.sparsity:.0%}"
            how = f"{run.method or run.conf_file or 'rigl'}{share}"
        if run.method and run.conf_file:
            how += f" of {run.conf_file}"
        changed = "".join(f", {name} {value}" for name, value in run.hyperparams.items())
        where = "" if run.distribution is None else f" {run.distribution}"
        return f"{run.algo} {run.env_id} {how}{where}{changed}, seed {run.seed}"


def _plain(value: Any) -> Any:
    if isinstance(value, type):
        return f"{value.__module__}.{value.__qualname__}"
    raise TypeError(f"a study cannot hold {value!r}; give plain values")
