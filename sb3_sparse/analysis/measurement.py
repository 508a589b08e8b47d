"""The base class of measuring callbacks: when to measure, and a CSV file that resumes."""

from __future__ import annotations

import csv
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_sparse.analysis.batches import has_batch
from sb3_sparse.errors import ConfigError, CorruptStateError
from sb3_sparse.files import write_csv
from sb3_sparse.loading.guard import reading
from sb3_sparse.loading.text import read_text
from sb3_sparse.sparsity.numeric import is_whole

HEADS = ("timesteps", "name", "value")


class MeasurementFile:
    """A CSV file with rows ``timesteps,name,value``.

    :param path: of the file; its folder is created
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def begin(self, timesteps: int) -> None:
        """Drop rows that are later than the model; a model at step 0 starts an empty file.

        :param timesteps: environment steps that the model has seen
        :raises CorruptStateError: if the file has another form
        """
        rows = self._rows() if timesteps and self.path.exists() else []
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_csv(self.path, HEADS, (row for row in rows if int(row[0]) <= timesteps))

    def _rows(self) -> list[list[str]]:
        text = read_text(self.path, "file of measurements", "give another path, or remove it")
        whole = text[: text.rfind("\n") + 1]  # a killed process may leave half a line
        with reading(self.path, "file of measurements", "give another path, or remove it"):
            head, *rows = list(csv.reader(whole.splitlines())) or [list(HEADS)]
        if tuple(head) != HEADS or any(len(r) != 3 or not r[0].isdigit() for r in rows):
            raise CorruptStateError(
                f"{self.path} is not a file of measurements with columns {', '.join(HEADS)}; give "
                "another path, or remove it"
            )
        return rows

    def append(self, timesteps: int, values: Mapping[str, float]) -> None:
        """Add a row for each value."""
        with self.path.open("a", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerows((timesteps, name, value) for name, value in values.items())


class MeasurementCallback(BaseCallback):
    """Measures every few environment steps, and writes to SB3's logger and a file.

    Off-policy algorithms are measured after an environment step, once learning has started, and
    on-policy algorithms at the end of the rollout in which a measurement was due.

    :param every: environment steps between two measurements
    :param path: CSV file with rows ``timesteps,name,value``; None: only SB3's logger. A
        resumed model continues it, and rows later than the model are dropped
    :param verbose: as in SB3
    :raises ConfigError: if ``every`` is not a positive integer
    """

    def __init__(self, every: int, path: str | Path | None = None, verbose: int = 0) -> None:
        super().__init__(verbose)
        if not is_whole(every) or every < 1:
            raise ConfigError(f"every must be environment steps, 1 or more, got {every!r}")
        self.every = every
        self.file = None if path is None else MeasurementFile(path)

    @abstractmethod
    def measure(self, seed: int) -> Mapping[str, float]:
        """Values by name, measured without changing the model.

        :param seed: seed of random draws; the same at the same environment step of the same run
        """

    def _on_training_start(self) -> None:
        if self.file is not None:
            self.file.begin(self.model.num_timesteps)

    def _on_step(self) -> bool:
        learning = self.model.num_timesteps > getattr(self.model, "learning_starts", 0)
        if not isinstance(self.model, OnPolicyAlgorithm) and learning:
            self._measure_if_due(self.training_env.num_envs)
        return True

    def _on_rollout_end(self) -> None:
        if isinstance(self.model, OnPolicyAlgorithm):
            self._measure_if_due(self.model.n_steps * self.training_env.num_envs)

    def _measure_if_due(self, since: int) -> None:
        now = self.model.num_timesteps
        if now // self.every == (now - since) // self.every or not has_batch(self.model):
            return
        values = self.measure((self.model.seed or 0) * 1_000_003 + now)
        for name, value in values.items():
            self.logger.record(name, value)
        if self.file is not None:
            self.file.append(now, values)
