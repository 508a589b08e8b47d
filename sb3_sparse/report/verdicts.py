"""The paper's findings tested on runs, each by a written rule."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from statistics import fmean

from sb3_sparse.report.data import Array, RunData
from sb3_sparse.report.measured import NOISE, SNR, returns_by_sigma, snr_by_network
from sb3_sparse.report.methods import DENSE, EQUAL, percent
from sb3_sparse.report.results import Results
from sb3_sparse.report.statistics import difference, iqm, rectangle

DYNAMIC = ("prune", "set", "rigl")
SMALL_DECAY, SMALL_SHARE = 1e-4, 0.2
ROUNDING = 0.005
Scores = Mapping[str, list[float]]
Valued = tuple[RunData, float]
Which = Callable[[RunData], bool]
SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "not enough data"
LEAST_SEEDS = 3
NO_LOSS, SAME = 0.05, 0.1
NO_MARGIN = "the other side's IQM is not above 0, so no margin can be a share of it"


@dataclass(frozen=True)
class Sides:
    """The two sides of a comparison, over the same strata.

    :param x: scores of the one side by stratum, one per seed
    :param y: scores of the other side
    :param why: what is missing if there is no stratum
    """

    x: Scores = field(default_factory=dict)
    y: Scores = field(default_factory=dict)
    why: str = ""


def sparse_and_equal(results: Results, family: str) -> Sides:
    """Compare pruning, SET and RigL with the dense network of as many parameters."""
    return _sides(
        _scored(results, _of_family(results.main, family)),
        lambda run: run.label in DYNAMIC and run.level >= 0.5,
        lambda run: run.label == EQUAL and run.level >= 0.5,
        _at_level,
        "no pruned, SET or RigL run beside a parameter-equivalent dense one",
    )


def sparse_and_dense(results: Results, family: str) -> Sides:
    """Compare pruning, SET and RigL at 80 to 90 % with the dense network of full size."""
    return _sides(
        _scored(results, _of_family(results.main, family)),
        lambda run: run.label in DYNAMIC and 0.8 - ROUNDING <= run.level <= 0.9 + ROUNDING,
        lambda run: run.label == DENSE,
        lambda run: run.env_id,
        "no pruned, SET or RigL run at 80 to 90 % beside a dense one of full size",
    )


def rigl_and_set(results: Results, family: str) -> Sides:
    """Compare RigL with SET at 50 to 95 %."""
    return _sides(
        _scored(results, _of_family(results.main, family)),
        lambda run: run.label == "rigl" and 0.5 <= run.level <= 0.95 + ROUNDING,
        lambda run: run.label == "set" and 0.5 <= run.level <= 0.95 + ROUNDING,
        _at_level,
        "no RigL run beside a SET run",
    )


def by_distribution(results: Results, family: str) -> Sides:
    """Compare ERK with uniform sparsity."""

    def has(distribution: str) -> Which:
        return lambda run: (
            run.label not in (DENSE, EQUAL) and results.setting(run, "distribution") == distribution
        )

    return _sides(
        _scored(results, _of_family(results.trained, family)),
        has("erk"),
        has("uniform"),
        _all_but("distribution"),
        "no runs that differ only in ERK and uniform",
    )


def by_share(results: Results, family: str) -> Sides:
    """Compare a small actor with a small critic."""
    shared = (run for run in _of_family(results.trained, family) if run.actor_share is not None)
    return _sides(
        _scored(results, shared),
        lambda run: (run.actor_share or 0.0) <= SMALL_SHARE + ROUNDING,
        lambda run: (run.actor_share or 0.0) >= 1 - SMALL_SHARE - ROUNDING,
        _all_but("actor_share"),
        "no run with a small actor beside one with a small critic",
    )


def by_weight_decay(results: Results, family: str) -> Sides:
    """Compare a small weight decay with none."""

    def decay(run: RunData) -> float:
        return float(str(results.setting(run, "weight_decay") or 0))

    return _sides(
        _scored(results, _of_family(results.trained, family)),
        lambda run: 0 < decay(run) <= SMALL_DECAY * (1 + 1e-9),
        lambda run: decay(run) == 0,
        _all_but("weight_decay"),
        "no runs that differ only in a small weight decay and none",
    )


def by_snr(results: Results, family: str) -> Sides:
    """Compare the log SNR at the highest sparsity with that at the lowest, by network."""
    found: dict[str, list[Valued]] = defaultdict(list)
    for run in _of_family(results.main, family):
        if run.label != EQUAL:
            for network, points in snr_by_network(run.measured).items():
                logs = [math.log(value) for _, value in points if value > 0]
                if logs:
                    found[f"{run.env_id}, {network}"].append((run, fmean(logs)))
    x, y = {}, {}
    for stratum, pairs in sorted(found.items()):
        levels = {run.level for run, _ in pairs}
        if len(levels) > 1:
            x[stratum] = _by_seed([pair for pair in pairs if pair[0].level == max(levels)])
            y[stratum] = _by_seed([pair for pair in pairs if pair[0].level == min(levels)])
    return Sides(x, y, f"no {SNR} at two sparsities")


def by_noise(results: Results, family: str) -> Sides:
    """Compare what strong noise costs sparse and parameter-equivalent dense networks."""
    found: list[Valued] = []
    for run in _of_family(results.main, family):
        by_sigma = returns_by_sigma(run.measured)
        strong = [sigma for sigma in by_sigma if sigma > max(by_sigma) / 2]
        if 0.0 in by_sigma and strong:
            noisy = results.normaliser(run, fmean(by_sigma[sigma] for sigma in strong))
            quiet = results.normaliser(run, by_sigma[0.0])
            if noisy is not None and quiet is not None:
                found.append((run, noisy - quiet))
    return _sides(
        found,
        lambda run: run.label not in (DENSE, EQUAL),
        lambda run: run.label == EQUAL,
        _at_level,
        f"no {NOISE} with σ = 0 and more of a sparse run beside a parameter-equivalent dense one",
    )


def _of_family(runs: Iterable[RunData], family: str) -> list[RunData]:
    return [run for run in runs if run.family == family]


def _scored(results: Results, runs: Iterable[RunData]) -> list[Valued]:
    return [(run, score) for run in runs if (score := results.normaliser(run)) is not None]


def _at_level(run: RunData) -> str:
    return f"{run.env_id} at {percent(run.level)}"


def _all_but(name: str) -> Callable[[RunData], str]:
    return lambda run: f"{_at_level(run)}, {run.label}|{run.variant(name)}"


def _sides(
    pairs: list[Valued], x: Which, y: Which, stratum: Callable[[RunData], str], why: str
) -> Sides:
    """Split scored runs into two sides, over the strata that both have."""
    left, right = (_by_stratum((p for p in pairs if side(p[0])), stratum) for side in (x, y))
    both = sorted(left.keys() & right.keys())
    names = _short(both)
    return Sides(
        {names[one]: _by_seed(left[one]) for one in both},
        {names[one]: _by_seed(right[one]) for one in both},
        why,
    )


def _short(strata: list[str]) -> dict[str, str]:
    """Shorten strata to names without the text of all settings, numbered where they collide."""
    seen: dict[str, int] = defaultdict(int)
    names = {}
    for one in strata:
        head = one.split("|", 1)[0]
        seen[head] += 1
        names[one] = head if seen[head] == 1 else f"{head} ({seen[head]})"
    return names


def _by_stratum(
    pairs: Iterable[Valued], stratum: Callable[[RunData], str]
) -> dict[str, list[Valued]]:
    found: dict[str, list[Valued]] = defaultdict(list)
    for run, value in pairs:
        found[stratum(run)].append((run, value))
    return found


def _by_seed(pairs: list[Valued]) -> list[float]:
    """Average over methods and settings, for each seed that all of them have."""
    kinds: dict[tuple[str, float, str], dict[int, float]] = defaultdict(dict)
    for run, value in pairs:
        kinds[run.label, run.level, run.variant()][run.seed] = value
    seeds = set.intersection(*(set(kind) for kind in kinds.values()))
    return [fmean(kind[seed] for kind in kinds.values()) for seed in sorted(seeds)]


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

    def verdict(self, low: float, high: float, reference: float) -> tuple[str, str]:
        """Return the verdict on an interval, and a remark.

        :param low: lower end of the interval
        :param high: upper end of the interval
        :param reference: the other side's statistic
        """
        if self.relative and reference <= 0:
            return UNDECIDED, NO_MARGIN
        scale = reference if self.relative else 1.0
        remark = f"margin {-self.low * scale:.3g}" if self.relative else ""
        if low > self.low * scale and high < self.high * scale:
            return SUPPORTED, remark
        outside = high < self.low * scale or low > self.high * scale
        return CONTRADICTED if outside else UNDECIDED, remark


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
    :param sides: returns the scores of both sides by stratum
    :param region: the effects for which it holds
    :param statistic: the difference of this statistic is the effect
    :param unit: of the effect
    """

    key: str
    text: str
    rule: str
    sides: Callable[[Results, str], Sides]
    region: Region
    statistic: Callable[[Array], float]
    unit: str


@dataclass(frozen=True)
class Verdict:
    """The verdict of one family of runs on a finding.

    :param finding: the finding
    :param family: algorithm, architecture and suite; empty if no family has data
    :param verdict: supported, contradicted or not enough data
    :param effect: the difference of the two sides; None if there is none
    :param low: lower end of its 95 % interval
    :param high: upper end
    :param seeds: runs of each stratum, on the scarcer side
    :param strata: number of strata
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
    strata: int = 0
    remark: str = ""


def _average(scores: Array) -> float:
    return float(scores.mean())


IQM_UNIT, MEAN_UNIT = "normalised IQM", "normalised mean"
FINDINGS = (
    Finding(
        "equal-parameters",
        "Sparse networks beat dense ones with as many parameters.",
        "Pruning, SET and RigL (their mean) minus the parameter-equivalent dense network, at all "
        "sparsities from 50 % on; each environment and sparsity is a stratum",
        sparse_and_equal, GREATER, iqm, IQM_UNIT,
    ),
    Finding(
        "no-loss",
        "80 to 90 % sparse networks lose nothing against the dense one of full size.",
        "Pruning, SET and RigL at 80 to 90 % (mean over methods and sparsities) minus the dense "
        "network of full size; each environment is a stratum",
        sparse_and_dense, NOT_LESS, iqm, IQM_UNIT,
    ),
    Finding(
        "rigl-set",
        "RigL's gradients gain little over SET's random growth.",
        "RigL minus SET at 50 to 95 %; each environment and sparsity is a stratum",
        rigl_and_set, CLOSE, iqm, IQM_UNIT,
    ),
    Finding(
        "erk",
        "ERK is better than uniform sparsity.",
        "ERK minus uniform, all else the same; each environment, method and sparsity is a stratum",
        by_distribution, GREATER, _average, MEAN_UNIT,
    ),
    Finding(
        "critic",
        "The critic needs the parameters more than the actor.",
        "Runs whose actor has 20 % of the connections or less minus runs whose critic has, all "
        "else the same; each environment, method and sparsity is a stratum",
        by_share, GREATER, _average, MEAN_UNIT,
    ),
    Finding(
        "weight-decay",
        "A small weight decay helps.",
        "Weight decay above 0 and up to 1e-4 minus none, all else the same; each environment, "
        "method and sparsity is a stratum",
        by_weight_decay, GREATER, _average, MEAN_UNIT,
    ),
    Finding(
        "snr",
        "The gradients' signal-to-noise ratio falls with sparsity.",
        "Mean natural logarithm of the SNR over training at the highest sparsity minus that at the "
        "lowest (dense is 0 %); each environment and network is a stratum",
        by_snr, LESS, _average, "log SNR",
    ),
    Finding(
        "noise",
        "Sparse networks bear observation noise better than dense ones with as many parameters.",
        "What the upper half of the strengths of noise costs (mean normalised return minus that "
        "without noise): sparse minus parameter-equivalent dense; each environment and sparsity "
        "is a stratum",
        by_noise, GREATER, _average, MEAN_UNIT,
    ),
)  # fmt: skip


def judge(results: Results) -> list[Verdict]:
    """Judge each finding by each family of runs that has data on it.

    A finding without data has one verdict, "not enough data", that says what is missing.
    """
    found = []
    for finding in FINDINGS:
        given = [(family, finding.sides(results, family)) for family in results.families()]
        known = [(family, sides) for family, sides in given if sides.x]
        if not known:
            why = "; ".join(dict.fromkeys(sides.why for _, sides in given)) or "no trained run"
            found.append(Verdict(finding, "", UNDECIDED, remark=why))
        found += [_verdict(finding, family, sides) for family, sides in known]
    return found


def _verdict(finding: Finding, family: str, sides: Sides) -> Verdict:
    fit = [
        stratum
        for stratum in sides.x
        if min(len(sides.x[stratum]), len(sides.y[stratum])) >= LEAST_SEEDS
    ]
    x = rectangle({stratum: sides.x[stratum] for stratum in fit}, LEAST_SEEDS)
    y = rectangle({stratum: sides.y[stratum] for stratum in fit}, LEAST_SEEDS)
    few = [stratum for stratum in sides.x if stratum not in fit]
    remark = f"fewer than {LEAST_SEEDS} seeds of both sides: {', '.join(few)}" if few else ""
    if x is None or y is None:
        return Verdict(finding, family, UNDECIDED, remark=remark)
    remark = "; ".join([*([remark] if remark else []), *dict.fromkeys((*x.remarks, *y.remarks))])
    effect = difference(x.scores, y.scores, finding.statistic)
    reference = finding.statistic(y.scores)
    verdict, why = finding.region.verdict(effect.low, effect.high, reference)
    remark = "; ".join(text for text in (why, remark) if text)
    return Verdict(
        finding, family, verdict, effect.value, effect.low, effect.high, effect.seeds,
        effect.tasks, remark,
    )  # fmt: skip
