"""Hooks on a set of objects, registered again when the set changes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from torch.utils.hooks import RemovableHandle


class Hooks:
    """Handles of hooks on weights or optimizers. Copies and pickles have none."""

    def __init__(self) -> None:
        self._hooked: list[object] = []
        self._handles: list[RemovableHandle] = []

    def __getstate__(self) -> dict[str, Any]:
        return {"_hooked": [], "_handles": []}

    def attach(
        self, objects: Sequence[object], register: Callable[[], list[RemovableHandle]]
    ) -> bool:
        """Make sure that exactly these objects have the hooks.

        :param register: registers the hooks
        :return: whether it was called
        """
        if len(objects) == len(self._hooked) and all(
            one is other for one, other in zip(objects, self._hooked, strict=True)
        ):
            return False
        self.remove()
        self._handles = register()
        self._hooked = list(objects)
        return True

    def remove(self) -> None:
        """Remove the hooks."""
        for handle in self._handles:
            handle.remove()
        self._handles, self._hooked = [], []
