"""Whether modules still are what they were when somebody looked at them."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from operator import is_
from typing import Any

from torch import nn


def patched(module: nn.Module) -> bool:
    """Whether somebody has put a function of his own over one of the methods."""
    kind = type(module)
    return any(callable(getattr(kind, name, None)) for name in vars(module))


class ChangeDetector:
    """Notices when a module gets or loses a child, a tensor or an attribute.

    That is how modules are replaced, patched, parametrized and pruned. What tensors hold may change
    freely. A look takes a microsecond or two, where walking over the modules takes fifty.

    :param modules: what to watch
    :param tensors: whether their parameters and buffers shall be the same objects too
    """

    def __init__(self, modules: Iterable[nn.Module], tensors: bool = True) -> None:
        kinds = ("_modules", "_parameters", "_buffers") if tensors else ("_modules",)
        attributes = [vars(module) for module in modules]
        named = [held[kind] for held in attributes for kind in kinds]
        self._named = [names for names in named if names]
        self._seen: list[Any] = list(chain.from_iterable(map(dict.values, self._named)))
        self._sized = attributes + named
        self._sizes = list(map(len, self._sized))

    def unchanged(self) -> bool:
        """Whether all of it is as it was."""
        return list(map(len, self._sized)) == self._sizes and all(
            map(is_, chain.from_iterable(map(dict.values, self._named)), self._seen)
        )
