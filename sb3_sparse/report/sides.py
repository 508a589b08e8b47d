"""The two sides of each finding's comparison, and their scores."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from statistics import fmean

from sb3_sparse.report.data import RunData
from sb3_sparse.report.measured import NOISE, SNR, returns_by_sigma, snr_by_network
from sb3_sparse.report.methods import DENSE, EQUAL, percent
from sb3_sparse.report.results import Results

DYNAMIC = ("prune", "set", "rigl")
SMALL_DECAY, SMALL_SHARE = 1e-4, 0.2
ROUNDING = 0.005
Scores = Mapping[str, list[float]]
Valued = tuple[RunData, float]
Pairs = Mapping[str, list[Valued]]
Which = Callable[[RunData], bool]


@dataclass(frozen=True)
class Sides:
    """The two sides of a comparison, over the same strata.

    :param x: scores of the one side by stratum, one per seed
    :param y: scores of the other side
    :param why: what is missing if there is no stratum
    :param runs: the runs whose scores they are
    """

    x: Scores = field(default_factory=dict)
    y: Scores = field(default_factory=dict)
    why: str = ""
    runs: tuple[RunData, ...] = ()

    def with_seeds(self, least: int) -> Sides:
        """Return the comparisons of which both sides have at least so many seeds."""
        fit = [name for name in self.x if min(len(self.x[name]), len(self.y[name])) >= least]
        x, y = ({name: side[name] for name in fit} for side in (self.x, self.y))
        return Sides(x, y, self.why, self.runs)


def sparse_and_equal(results: Results, family: str) -> Sides:
    """Compare pruning, SET and RigL with the dense network of as many parameters."""
    return _sides(
        _scored(results, results.main, family),
        lambda run: run.label in DYNAMIC and run.level >= 0.5,
        lambda run: run.label == EQUAL and run.level >= 0.5,
        _at_level,
        "no pruned, SET or RigL run beside a parameter-equivalent dense one",
    )


def sparse_and_dense(results: Results, family: str) -> Sides:
    """Compare pruning, SET and RigL at 80 to 90 % with the dense network of full size."""
    return _sides(
        _scored(results, results.main, family),
        lambda run: run.label in DYNAMIC and 0.8 - ROUNDING <= run.level <= 0.9 + ROUNDING,
        lambda run: run.label == DENSE,
        lambda run: run.env_id,
        "no pruned, SET or RigL run at 80 to 90 % beside a dense one of full size",
    )


def rigl_and_set(results: Results, family: str) -> Sides:
    """Compare RigL with SET at 50 to 95 %."""
    return _sides(
        _scored(results, results.main, family),
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
        _scored(results, results.trained, family),
        has("erk"),
        has("uniform"),
        _all_but("distribution"),
        "no runs that differ only in ERK and uniform",
    )


def by_share(results: Results, family: str) -> Sides:
    """Compare a small actor with a small critic."""
    shared = [run for run in results.trained if run.actor_share is not None]
    return _sides(
        _scored(results, shared, family),
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
        _scored(results, results.trained, family),
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
    high, low = {}, {}
    for stratum, pairs in sorted(found.items()):
        levels = {run.level for run, _ in pairs}
        if len(levels) > 1:
            high[stratum] = [pair for pair in pairs if pair[0].level == max(levels)]
            low[stratum] = [pair for pair in pairs if pair[0].level == min(levels)]
    return _both(high, low, {one: one for one in high}, f"no {SNR} at two sparsities")


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


def _scored(results: Results, runs: Iterable[RunData], family: str) -> list[Valued]:
    scores = ((run, results.normaliser(run)) for run in _of_family(runs, family))
    return [(run, score) for run, score in scores if score is not None]


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
    return _both(left, right, _short(both), why)


def _both(x: Pairs, y: Pairs, names: Mapping[str, str], why: str) -> Sides:
    """Make both sides of scored runs, over the strata that have a name."""
    runs = [run for side in (x, y) for one in names for run, _ in side[one]]
    return Sides(
        {name: _by_seed(x[one]) for one, name in names.items()},
        {name: _by_seed(y[one]) for one, name in names.items()},
        why,
        tuple(dict.fromkeys(runs)),
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
