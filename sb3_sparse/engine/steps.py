"""The steps in which the kernels compute networks: one for each layer, with what surrounds it."""

from __future__ import annotations

from typing import NamedTuple

import torch as th
from torch import nn

from sb3_sparse.engine.masked import FLOAT_MASK_KEY
from sb3_sparse.engine.norms import features_of, tensors_of_norm
from sb3_sparse.engine.paths import Paths, parts_of

MOST_STEPS = 64
"""``MOST_STEPS`` of ``kernels.h``."""


class Step(NamedTuple):
    """One layer, and what surrounds it as in :class:`~sb3_sparse.engine.paths.Part`.

    :param layer: the layer
    :param activation: None: no activation
    :param norm: norm of its input; None: there is none
    :param source: number of the step that gives its input; -1: the observations
    :param shortcut: number of the step whose result is added, -1: the observations; None: nothing
        is added
    """

    layer: nn.Linear
    activation: nn.Module | None
    norm: nn.Module | None
    source: int
    shortcut: int | None


def steps_of(paths: Paths) -> tuple[list[Step], list[int]] | None:
    """Find the steps of some networks; None if they have parts that the kernels do not compute.

    :param paths: modules of each network; layers that two networks share are computed once
    :return: the steps in the order of computation, and the number of each network's last
    """
    steps: list[Step] = []
    places: dict[tuple[int, ...], int] = {}
    ends = []
    for path in paths:
        parts = parts_of(path)
        if not parts:
            return None
        key: tuple[int, ...] = ()
        numbers = [-1]  # of the steps of this path, behind the observations
        for layer, activation, norm, shortcut in parts:
            if layer is None:
                return None
            key += (id(layer), id(activation), id(norm), -2 if shortcut is None else shortcut)
            if key not in places:
                places[key] = len(steps)
                added = None if shortcut is None else numbers[shortcut + 1]
                steps.append(Step(layer, activation, norm, numbers[-1], added))
            numbers.append(places[key])
        ends.append(numbers[-1])
    inputs = {step.layer.in_features for step in steps if step.source < 0}
    if not steps or not all(_fits(step, steps) for step in steps):
        return None
    if len(steps) > MOST_STEPS or len(set(ends)) < len(ends) or len(inputs) > 1:
        return None
    return steps, ends


def tensors_of(step: Step) -> tuple[th.Tensor | None, ...]:
    """Return the weight, bias and mask of a step's layer, and the tensors of its norm."""
    layer, norm = step.layer, step.norm
    mask = layer._buffers.get(FLOAT_MASK_KEY)
    return layer.weight, layer.bias, mask, *tensors_of_norm(norm)


def _fits(step: Step, steps: list[Step]) -> bool:
    """Whether a step, its norm and what is added to it agree in their numbers of features."""
    columns, rows = step.layer.in_features, step.layer.out_features

    def width(source: int, first: int) -> int:
        return first if source < 0 else steps[source].layer.out_features

    return (
        width(step.source, columns) == columns
        and (step.norm is None or features_of(step.norm) == (columns,))
        and (step.shortcut is None or width(step.shortcut, steps[0].layer.in_features) == rows)
    )
