"""The optimizers whose steps programs can take."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain
from operator import itemgetter
from typing import Any, NamedTuple

import torch as th

from sb3_sparse.engine.controller import Controller
from sb3_sparse.engine.internals import step_hooks
from sb3_sparse.engine.native.library import bits_of

FIELDS = 7
"""Fields of ``group_t`` of ``fused.h``."""
Moments = tuple[th.Tensor | None, th.Tensor, th.Tensor | None]
"""First and second moment, and the step counter if it is a tensor."""


class Known(NamedTuple):
    """An optimizer that programs know.

    :param names: settings of a parameter group, in the order of the arguments of ``fields``
    :param fields: gives ``group_t`` of ``fused.h``; None for settings that programs do not know
    :param moments: names of the first and the second moment; "" if there is none
    """

    names: tuple[str, ...]
    fields: Callable[..., list[int] | None]
    moments: tuple[str, str]


def _adam(
    rate: Any, betas: Any, epsilon: Any, decay: Any, decoupled: bool, *others: bool
) -> list[int] | None:
    numbers = (rate, *betas, epsilon, decay)
    if any(others) or any(isinstance(number, th.Tensor) for number in numbers):
        return None
    return [0, *map(bits_of, map(float, numbers)), int(decoupled)]


_COMMON = ("maximize", "capturable", "differentiable")
_ADAM = Known(
    ("lr", "betas", "eps", "weight_decay", "decoupled_weight_decay", "amsgrad", *_COMMON),
    _adam,
    ("exp_avg", "exp_avg_sq"),
)


def rmsprop(kind: int) -> Callable[..., list[int] | None]:
    """Make the ``fields`` of RMSprop, whose moments decay at ``alpha``.

    :param kind: 1, or 2 for TensorFlow's variant, with epsilon within the root
    """

    def fields(
        rate: Any, alpha: float, epsilon: float, decay: float, *others: Any
    ) -> list[int] | None:
        if any(others) or isinstance(rate, th.Tensor):
            return None
        return [kind, *map(bits_of, map(float, (rate, 0.0, alpha, epsilon, decay))), 0]

    return fields


_RMSPROP = Known(
    ("lr", "alpha", "eps", "weight_decay", "momentum", "centered", *_COMMON),
    rmsprop(1),
    ("", "square_avg"),
)
KNOWN: dict[type[th.optim.Optimizer], Known] = {
    th.optim.Adam: _ADAM,
    th.optim.AdamW: _ADAM,
    th.optim.RMSprop: _RMSPROP,
}


class Steps:
    """Tracks whether the kernels can take an optimizer's steps, and with which settings.

    :param optimizer: the optimizer
    :param moved: its parameters that have a gradient
    :param controller: the controller whose hooks on the optimizer are ignored
    """

    def __init__(
        self, optimizer: th.optim.Optimizer, moved: Sequence[th.Tensor], controller: Controller
    ) -> None:
        self._optimizer: Any = optimizer
        self._moved = list(moved)
        self._controller = controller
        self._known = KNOWN.get(type(optimizer))
        self._getter = itemgetter(*self._known.names) if self._known else None
        self._settings: Any = None
        self._hooks: Any = None
        self.groups: list[list[int]] | None = None
        """``group_t`` of each parameter group; None: torch takes the steps."""
        self.counts = False
        """Whether the step counters are numbers, which the kernels cannot count."""

    def refresh(self) -> None:
        """Read the present settings and hooks."""
        if self._known is None or self._getter is None:
            return
        optimizer = self._optimizer
        settings = list(map(self._getter, optimizer.param_groups))
        hooks = ["step" in vars(optimizer), *map(len, step_hooks(optimizer))]
        if settings == self._settings and hooks == self._hooks:
            return
        self._settings, self._hooks = settings, hooks
        self.groups = None
        if "step" not in vars(optimizer) and not self._watched():
            groups = [self._known.fields(*group) for group in settings]
            if None not in groups:
                self.groups = groups  # type: ignore[assignment]

    def _watched(self) -> bool:
        """Whether anybody but the controller and this package has hooks on the steps."""
        pre, post, *everywhere = step_hooks(self._optimizer)
        own = (*pre.values(), *post.values())
        every = chain.from_iterable(hooks.values() for hooks in everywhere)
        return any(getattr(hook, "__self__", None) is not self._controller for hook in own) or any(
            not hook.__module__.startswith("sb3_sparse.") for hook in every
        )

    def state(self) -> list[Any]:
        """Return a list that changes whenever the optimizer has other tensors for its moments."""
        if self.groups is None:
            return [None]
        state = self._optimizer.state
        held = [state.get(tensor, {}) for tensor in self._moved]
        return [len(self.groups), *map(id, chain.from_iterable(map(dict.values, held)))]

    @property
    def ready(self) -> bool:
        """Whether the kernels know the optimizer and its moments exist."""
        return self.groups is not None and all(map(self._optimizer.state.get, self._moved))

    def moments(self, tensor: th.Tensor) -> Moments:
        """Return the moments of a parameter."""
        assert self._known is not None
        state = self._optimizer.state[tensor]
        first, second = self._known.moments
        steps = state["step"]
        self.counts = not isinstance(steps, th.Tensor)
        return (state[first] if first else None, state[second], None if self.counts else steps)

    def count(self) -> None:
        """Count a step of the kernels where they cannot count it."""
        if self.counts:
            for tensor in self._moved:
                self._optimizer.state[tensor]["step"] += 1
