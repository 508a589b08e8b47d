"""The formulas of SimBa (arXiv:2410.09754), written out by hand."""

from __future__ import annotations

from collections.abc import Mapping

import torch as th


def simba_by_hand(weights: Mapping[str, th.Tensor], blocks: int, x: th.Tensor) -> th.Tensor:
    """What a SimBa network gives, and its head if it has one, from its parameters by name."""

    def linear(name, x):
        return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]

    def norm(name, x):
        centred = x - x.mean(-1, keepdim=True)
        scaled = centred / (centred.square().mean(-1, keepdim=True) + 1e-6).sqrt()
        return scaled * weights[f"{name}.weight"] + weights[f"{name}.bias"]

    h = linear("0", x)
    for number in range(1, blocks + 1):
        name = f"{number}.residual"
        inner = linear(f"{name}.1", norm(f"{name}.0", h)).clamp(min=0)
        h = h + linear(f"{name}.3", inner)
    h = norm(f"{blocks + 1}", h)
    head = f"{blocks + 2}"
    return linear(head, h) if f"{head}.weight" in weights else h
