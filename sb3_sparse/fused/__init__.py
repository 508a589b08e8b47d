"""Gradient steps as programs that the kernels run in one call.

A program is recorded once, by writing losses with values that stand for batches of numbers, and run
for every gradient step. docs/gradient_steps.md shows an algorithm that records its own.
"""

from sb3_sparse.fused.distributions import (
    bernoulli,
    categorical,
    gaussian,
    least_of,
    multi_categorical,
    squashed_gaussian,
)
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.parts import parts
from sb3_sparse.fused.program import Program
from sb3_sparse.fused.quantiles import argmax, quantile_huber, sort, sum_blocks
from sb3_sparse.fused.values import Value

__all__ = [
    "NotCovered",
    "Program",
    "Value",
    "argmax",
    "bernoulli",
    "categorical",
    "gaussian",
    "least_of",
    "multi_categorical",
    "parts",
    "quantile_huber",
    "sort",
    "squashed_gaussian",
    "sum_blocks",
]
