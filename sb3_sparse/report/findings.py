"""The findings of the paper, and the rule by which each is tested."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from sb3_sparse.errors import check_choice
from sb3_sparse.report.data import Array
from sb3_sparse.report.results import Results
from sb3_sparse.report.sides import (
    Sides,
    by_distribution,
    by_noise,
    by_share,
    by_snr,
    by_weight_decay,
    rigl_and_set,
    sparse_and_dense,
    sparse_and_equal,
)
from sb3_sparse.report.statistics import Estimate, iqm, seeds_for

SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "not enough data"
NO_LOSS, SAME = 0.05, 0.1


@dataclass(frozen=True)
class Region:
    """The effects for which a finding holds.

    A finding is supported if the effect's interval lies inside, contradicted if it lies outside.

    :param text: the same in words
    :param low: lower end
    :param high: upper end
    :param relative: whether the ends are shares of the other side's statistic
    """

    text: str
    low: float = -math.inf
    high: float = math.inf
    relative: bool = False

    def scaled(self, reference: float) -> Region | None:
        """Return the region in the effect's unit.

        :param reference: the other side's statistic
        :return: None if the ends are shares of a statistic that is not above 0
        """
        if not self.relative:
            return self
        if reference <= 0:
            return None
        return Region(self.text, self.low * reference, self.high * reference)

    def verdict(self, effect: Estimate) -> str:
        """Return the verdict on an effect, of a region in its unit."""
        if effect.low > self.low and effect.high < self.high:
            return SUPPORTED
        outside = effect.high < self.low or effect.low > self.high
        return CONTRADICTED if outside else UNDECIDED

    def needed(self, effect: Estimate) -> int | None:
        """Return the seeds that would decide an open effect if it stays as it is.

        :param effect: an effect in the region's unit
        :return: None for more than 1,000
        """
        below, above = effect.value - effect.low, effect.high - effect.value
        if self.low < effect.value < self.high:
            ways = [(effect.value - self.low, below), (self.high - effect.value, above)]
        elif effect.value <= self.low:
            ways = [(self.low - effect.value, above)]
        else:
            ways = [(effect.value - self.high, below)]
        share = min(room / reach for room, reach in ways if reach > 0)
        return seeds_for(effect, share) if share > 0 else None


GREATER = Region("supported if the interval lies above 0, contradicted if it lies below", low=0.0)
LESS = Region("supported if the interval lies below 0, contradicted if it lies above", high=0.0)
NOT_LESS = Region(
    f"supported if the interval lies above -{NO_LOSS:.0%} of the dense IQM, contradicted if it "
    "lies below that",
    low=-NO_LOSS,
    relative=True,
)
CLOSE = Region(
    f"supported if the interval lies within +-{SAME:.0%} of SET's IQM, contradicted if it lies "
    "outside",
    -SAME,
    SAME,
    relative=True,
)


@dataclass(frozen=True)
class Finding:
    """A finding of the paper, and how it is tested.

    :param key: its name
    :param text: the finding
    :param rule: what is compared
    :param sides: returns the scores of both sides by comparison
    :param region: the effects for which it holds
    :param statistic: the difference of this statistic is the effect
    :param unit: unit of the effect
    """

    key: str
    text: str
    rule: str
    sides: Callable[[Results, str], Sides]
    region: Region
    statistic: Callable[[Array], float]
    unit: str


def _average(scores: Array) -> float:
    return float(scores.mean())


IQM_UNIT, MEAN_UNIT = "normalised IQM", "normalised mean"
FINDINGS = (
    Finding(
        "equal-parameters",
        "Sparse networks beat dense ones with as many parameters.",
        "Pruning, SET and RigL (their mean) minus the parameter-equivalent dense network, at all "
        "sparsities from 50 % on; each environment and sparsity is a comparison",
        sparse_and_equal, GREATER, iqm, IQM_UNIT,
    ),
    Finding(
        "no-loss",
        "80 to 90 % sparse networks lose nothing against the dense one of full size.",
        "Pruning, SET and RigL at 80 to 90 % (mean over methods and sparsities) minus the dense "
        "network of full size; each environment is a comparison",
        sparse_and_dense, NOT_LESS, iqm, IQM_UNIT,
    ),
    Finding(
        "rigl-set",
        "RigL's gradients gain little over SET's random growth.",
        "RigL minus SET at 50 to 95 %; each environment and sparsity is a comparison",
        rigl_and_set, CLOSE, iqm, IQM_UNIT,
    ),
    Finding(
        "erk",
        "ERK is better than uniform sparsity.",
        "ERK minus uniform, all else the same; each environment, method and sparsity is a "
        "comparison",
        by_distribution, GREATER, _average, MEAN_UNIT,
    ),
    Finding(
        "critic",
        "The critic needs the parameters more than the actor.",
        "Runs whose actor has 20 % of the connections or less minus runs whose critic has, all "
        "else the same; each environment, method and sparsity is a comparison",
        by_share, GREATER, _average, MEAN_UNIT,
    ),
    Finding(
        "weight-decay",
        "A small weight decay helps.",
        "Weight decay above 0 and up to 1e-4 minus none, all else the same; each environment, "
        "method and sparsity is a comparison",
        by_weight_decay, GREATER, _average, MEAN_UNIT,
    ),
    Finding(
        "snr",
        "The gradients' signal-to-noise ratio falls with sparsity.",
        "Mean natural logarithm of the SNR over training at the highest sparsity minus that at the "
        "lowest (dense is 0 %); each environment and network is a comparison",
        by_snr, LESS, _average, "log SNR",
    ),
    Finding(
        "noise",
        "Sparse networks bear observation noise better than dense ones with as many parameters.",
        "What the upper half of the strengths of noise costs (mean normalised return minus that "
        "without noise): sparse minus parameter-equivalent dense; each environment and sparsity "
        "is a comparison",
        by_noise, GREATER, _average, MEAN_UNIT,
    ),
)  # fmt: skip
"""The paper's findings, in the order in which pages judge them."""


def check_findings(keys: Iterable[str]) -> None:
    """Check keys of findings.

    :raises ConfigError: for an unknown key; lists those that are allowed
    """
    for key in keys:
        check_choice("finding", key, [finding.key for finding in FINDINGS])
