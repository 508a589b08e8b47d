"""What each step of a chain does in the backward pass."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torch import nn

from sb3_sparse.engine.image_step import ImageStep


class Backward(NamedTuple):
    """What the backward pass of a step does besides its products.

    :param gate: number of a map: the gradient of the source is 0 where that is not positive. None:
        it is what the products give
    :param adds: whether the gradient of the source has begun, so that this step adds to it
    :param slope: whether the pass begins with the slope of the step's activation
    """

    gate: int | None
    adds: bool
    slope: bool


def plan_backward(
    steps: Sequence[ImageStep], count: int
) -> tuple[list[Backward], set[int], list[int]]:
    """Plan the backward pass of a chain.

    :param count: number of maps
    :return: what each step does, the maps that it reads, and for each map the one that it shares
        its gradient with, which may be itself
    """
    producer = {step.output: step for step in steps}
    begun: set[int] = set()
    gated: set[int] = set()
    kept: set[int] = set()
    origin = list(range(count))
    backward: list[Backward] = []
    for step in reversed(steps):
        slope = step.activation is not None and step.output not in gated
        if slope:
            kept.add(step.output)
        if step.add is not None:
            if step.source != step.add:  # else the kernels would read what they write
                origin[step.add] = origin[step.output]
            begun.add(step.add)
        adds, gate = step.source in begun, None
        if step.weight is not None:
            kept.add(step.input)
            before = producer.get(step.source)
            if step.input != step.source:
                gate = step.input
            elif not adds and before is not None and type(before.activation) is nn.ReLU:
                gate = step.input
                gated.add(step.source)
        begun.add(step.source)
        backward.append(Backward(gate, adds, slope))
    return backward[::-1], kept, origin
