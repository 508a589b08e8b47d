"""Verdicts of runs on the findings of the paper."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

from sb3_sparse.pages.numbers import short
from sb3_sparse.report.findings import FINDINGS, UNDECIDED, Finding, Region, check_findings
from sb3_sparse.report.results import Results
from sb3_sparse.report.sides import Sides
from sb3_sparse.report.statistics import difference, rectangle

LEAST_SEEDS = 3
NOTHING, MOST_DECIMALS = 0.005, 6
NO_MARGIN = "the other side's IQM is not above 0, so no margin can be a share of it"


@dataclass(frozen=True)
class Verdict:
    """The verdict of one family of runs on a finding.

    :param finding: the finding
    :param family: algorithm, architecture and suite; empty if no family has data
    :param verdict: supported, contradicted or not enough data
    :param effect: the difference of the two sides; None if there is none
    :param low: lower end of its 95 % interval
    :param high: upper end
    :param seeds: runs of each comparison, on the scarcer side
    :param comparisons: their number
    :param needed: seeds that would decide an open verdict if the effect stays as it is; None for
        more than 1,000, and where there is no effect
    :param region: the effects for which the finding holds, in the effect's unit
    :param remark: why there is no verdict, or what it leaves out

    Example::

        from sb3_sparse.report import Results, judge

        for verdict in judge(Results(())):  # no runs, so there are no data on any finding
            print(verdict.finding.key, verdict.verdict, verdict.remark)
    """

    finding: Finding
    family: str
    verdict: str
    effect: float | None = None
    low: float | None = None
    high: float | None = None
    seeds: int = 0
    comparisons: int = 0
    needed: int | None = None
    region: Region | None = None
    remark: str = ""

    @property
    def shown(self) -> str:
        """The effect with its interval, e.g. ``"+0.22 [-0.10; +0.57]"``; empty without an effect.

        An end that two decimals would round to nothing shows on which side of it it lies.
        """
        if self.effect is None or self.low is None or self.high is None:
            return ""
        return f"{signed(self.effect)} [{signed(self.low)}; {signed(self.high)}]"

    @property
    def holds(self) -> str:
        """The effects for which the finding holds, e.g. ``"> -0.05"``; empty without an effect."""
        if self.region is None:
            return ""
        low, high = self.region.low, self.region.high
        if math.isinf(high):
            return f"> {short(low)}"
        return f"< {short(high)}" if math.isinf(low) else f"{short(low)} to {short(high)}"

    @property
    def has_data(self) -> bool:
        """Whether there are runs of both sides, however few."""
        return bool(self.family)


def signed(effect: float) -> str:
    """Write an effect with its sign and two decimals, or as many as its first digit needs."""
    if not effect or abs(effect) >= NOTHING:
        return f"{effect:+.2f}"
    digits = min(-math.floor(math.log10(abs(effect))), MOST_DECIMALS)
    return f"{effect:+.{digits}f}"


def judge(results: Results) -> list[Verdict]:
    """Judge each finding by each family of runs that has data on it.

    A finding without data has one verdict, "not enough data", that says what is missing.

    :param results: the runs, and the findings to judge
    :raises ConfigError: for an unknown key in the results' findings
    """
    return list(_judged(results))


@lru_cache(maxsize=1)  # a page judges, and so does its figure of findings: a bootstrap each
def _judged(results: Results) -> tuple[Verdict, ...]:
    asked = results.findings
    check_findings(asked or ())
    found = []
    for finding in (one for one in FINDINGS if asked is None or one.key in asked):
        given = [(family, finding.sides(results, family)) for family in results.families()]
        known = [(family, sides) for family, sides in given if sides.x]
        if not known:
            whys = [*dict.fromkeys(sides.why for _, sides in given)] or ["no trained run"]
            why = "; ".join([*whys, *(f"no scale: {one}" for one in results.normaliser.missing)])
            found.append(Verdict(finding, "", UNDECIDED, remark=why))
        found += [_verdict(finding, family, sides) for family, sides in known]
    return tuple(found)


def _verdict(finding: Finding, family: str, sides: Sides) -> Verdict:
    fit = sides.with_seeds(LEAST_SEEDS)
    x, y = rectangle(fit.x, LEAST_SEEDS), rectangle(fit.y, LEAST_SEEDS)
    few = [name for name in sides.x if name not in fit.x]
    remark = f"fewer than {LEAST_SEEDS} seeds of both sides: {', '.join(few)}" if few else ""
    if x is None or y is None:
        return Verdict(finding, family, UNDECIDED, remark=remark)
    remark = "; ".join([*([remark] if remark else []), *dict.fromkeys((*x.remarks, *y.remarks))])
    effect = difference(x.scores, y.scores, finding.statistic)
    region = finding.region.scaled(finding.statistic(y.scores))
    verdict = UNDECIDED if region is None else region.verdict(effect)
    needed = region.needed(effect) if region is not None and verdict == UNDECIDED else None
    remark = "; ".join([NO_MARGIN] * (region is None) + [remark] * bool(remark))
    return Verdict(
        finding, family, verdict, effect.value, effect.low, effect.high, effect.seeds,
        effect.tasks, needed, region, remark,
    )  # fmt: skip
