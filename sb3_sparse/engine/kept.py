"""Keeps an :class:`Inference` for as long as its modules stay the same."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import nn

from sb3_sparse.engine.changes import ChangeDetector
from sb3_sparse.engine.inference import Inference
from sb3_sparse.engine.paths import Paths, modules_of


class KeptInference:
    """Creates a new inference whenever modules have changed. Copies and pickles start empty."""

    def __init__(self) -> None:
        self._changes: ChangeDetector | None = None
        self._inference: Inference | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> KeptInference:
        return KeptInference()

    def __reduce__(self) -> Any:
        return KeptInference, ()

    def get(self, find: Callable[[], tuple[Paths, list[nn.Module]]]) -> Inference | None:
        """Return the inference; None where the modules must be called one by one.

        :param find: gives the paths, and the modules around them from the outermost inwards; hooks
            of the outermost run in any case, those of the others would be skipped
        """
        if self._changes is None or not self._changes.unchanged():
            paths, around = find()
            changes = ChangeDetector([*around, *modules_of(paths)])
            self._inference = Inference.of(paths, around[1:])
            self._changes = changes  # last, for other threads
        return self._inference
