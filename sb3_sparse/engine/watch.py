"""Whether modules still are what they were when somebody looked at them."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from typing import Any

from torch import nn


class Watch:
    """Notices when a module gets or loses a child, a tensor or an attribute.

    That is how modules are replaced, patched, parametrized and pruned. What tensors hold may change
    freely. A look takes a microsecond or two, where walking over the modules takes fifty.

    :param modules: what to watch
    :param tensors: whether their parameters and buffers shall be the same objects too
    """

    def __init__(self, modules: Iterable[nn.Module], tensors: bool = True) -> None:
        kinds = ("_modules", "_parameters", "_buffers") if tensors else ("_modules",)
        self._attributes = [vars(module) for module in modules]
        self._named = [held[kind] for held in self._attributes for kind in kinds]
        self._seen: list[Any] = list(chain.from_iterable(map(dict.values, self._named)))
        self._ids = list(map(id, self._seen))
        self._sizes = list(map(len, self._attributes))

    def unchanged(self) -> bool:
        """Whether all of it is as it was."""
        return (
            list(map(id, chain.from_iterable(map(dict.values, self._named)))) == self._ids
            and list(map(len, self._attributes)) == self._sizes
        )
