"""Hooks on a set of objects, put up anew when the set is another."""

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
        """Have hooks on these very objects, and no others.

        :param register: puts them up
        :return: whether it was necessary
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
        """Take the hooks off."""
        for handle in self._handles:
            handle.remove()
        self._handles, self._hooked = [], []
