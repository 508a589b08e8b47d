"""The record of a run, ``sparsity.json``: what was requested, what came out, how sparse it is."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import Any

from sb3_sparse.errors import CorruptStateError
from sb3_sparse.loading.guard import reading
from sb3_sparse.sparsity.numeric import is_whole
from sb3_sparse.zoo.settings import Settings
from sb3_sparse.zoo.spec import RunSpec

NAME = "sparsity.json"
WHAT = "record of a run"
CURE = "restore it from a copy, or remove the run's folder and train anew"
FORMAT = 1


class Status(str, Enum):
    """The state of a run. Each is a string too: ``Status.RUNNING == "running"``.

    Example::

        from sb3_sparse.zoo import Status

        print([str(status) for status in Status if status.is_over])
    """

    RUNNING = "running"
    """It is training, or was killed while training."""
    INTERRUPTED = "interrupted"
    """A signal stopped it; it resumes from its last checkpoint."""
    EVALUATING = "evaluating"
    """It has been trained; its last and best policies are being evaluated."""
    FINISHED = "finished"
    COUNTED = "counted"
    """Its networks were built and counted, and never trained."""
    DIVERGED = "diverged"
    """Its networks came to hold NaN or infinity. It cannot resume; reports do not average it."""
    FAILED = "failed"
    """It raised an error, which the record holds; it resumes from its last checkpoint."""
    PRUNED = "pruned"
    """A search stopped it early."""

    __str__ = str.__str__

    @property
    def is_over(self) -> bool:
        """Whether the run has nothing left to do."""
        return self in (Status.FINISHED, Status.COUNTED, Status.DIVERGED)


class Record(Mapping[str, Any]):
    """The content of a run's ``sparsity.json``, or of its line in an archive.

    A mapping of everything in the file. The properties check what they return.

    Example::

        from sb3_sparse.zoo import Record

        record = Record({"status": "finished", "num_timesteps": 100_000})
        print(record.status.is_over, record.num_timesteps)

    :param content: the file's mapping
    :param source: the file, for messages
    :param cure: what to do if it is damaged, for messages
    :raises CorruptStateError: if the status or the format is unknown
    """

    def __init__(
        self, content: Mapping[str, Any], source: Path = Path(NAME), cure: str = CURE
    ) -> None:
        self.source = source
        self.cure = cure
        self._content = content
        number = content.get("format", FORMAT)
        if not is_whole(number) or number > FORMAT:
            raise CorruptStateError(
                f"{source} has the format {number!r}, but this sb3-sparse reads up to {FORMAT}; "
                f"update sb3-sparse, or {cure}"
            )
        try:
            self.status = Status(content.get("status"))
        except ValueError as error:
            found = f"the status {content['status']!r}" if "status" in content else "no status"
            allowed = ", ".join(Status)
            raise CorruptStateError(
                f"{source} is damaged: it has {found}, but allowed are {allowed}; {cure}"
            ) from error

    def __getitem__(self, name: str) -> Any:
        return self._content[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._content)

    def __len__(self) -> int:
        return len(self._content)

    def reading(self) -> AbstractContextManager[None]:
        """Turn errors over a missing or mistyped entry into a CorruptStateError."""
        return reading(self.source, WHAT, self.cure)

    @property
    def num_timesteps(self) -> int:
        """Environment steps trained."""
        with self.reading():
            return int(self.get("num_timesteps", 0))

    @property
    def measured(self) -> Mapping[str, Any]:
        """Arguments of each measure taken of the trained model, by the measure's name."""
        with self.reading():
            return dict(self.get("measured", {}))

    @cached_property
    def spec(self) -> RunSpec:
        """The run's specification.

        :raises ConfigError: if it is not valid here, e.g. its environment is not registered
        """
        with self.reading():
            return RunSpec(**self["run"])

    @cached_property
    def settings(self) -> Settings:
        """The run's settings. Nothing that they name is imported."""
        with self.reading():
            return Settings(self._mapping("settings"), imports=False)

    @property
    def evaluation(self) -> dict[str, int]:
        """``eval_freq`` and ``eval_episodes``."""
        with self.reading():
            found = self._mapping("evaluation")
            for name in ("eval_freq", "eval_episodes"):
                if not is_whole(found[name]) or found[name] < 1:
                    raise CorruptStateError(
                        f"{self.source} is damaged: {name} is {found[name]!r}; {self.cure}"
                    )
            return dict(found)

    def _mapping(self, name: str) -> Mapping[str, Any]:
        found = self[name]
        if not isinstance(found, Mapping):
            raise CorruptStateError(f"{self.source} is damaged: {name} is {found!r}; {self.cure}")
        return found


def as_json(content: Mapping[str, Any]) -> str:
    """Return the text of a record's file."""
    return json.dumps(dict(content), indent=1, default=_plain) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, type):
        return f"{value.__module__}.{value.__qualname__}"  # which a policy can import again
    if isinstance(value, Mapping):
        return dict(value)
    return str(value)
