"""The two sides of each finding: scores by stratum, an entry a seed, in the order of seeds."""

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
CLOSE = 0.005
Scores = Mapping[str, list[float]]


@dataclass(frozen=True)
class Sides:
    """Both sides of a comparison, over the same strata.

    :param x: scores by stratum, an entry a seed
    :param y: of the other side
    :param why: what is missing if there is no stratum
    """

    x: Scores = field(default_factory=dict)
    y: Scores = field(default_factory=dict)
    why: str = ""


Valued = tuple[RunData, float]


def sparse_and_equal(results: Results, family: str) -> Sides:
    """Pruning, SET and RigL, and the dense network of as many parameters."""
    found = _scored(results, (run for run in _main(results, family) if run.level >= 0.5))
    return _sides(
        [pair for pair in found if pair[0].label in DYNAMIC],
        [pair for pair in found if pair[0].label == EQUAL],
        _at_level,
        "no pruned, SET or RigL run beside a parameter-equivalent dense one",
    )


def sparse_and_dense(results: Results, family: str) -> Sides:
    """Pruning, SET and RigL at 80 to 90 %, and the dense network of full size."""
    found = _scored(results, _main(results, family))
    return _sides(
        [
            (run, score)
            for run, score in found
            if run.label in DYNAMIC and 0.8 - CLOSE <= run.level <= 0.9 + CLOSE
        ],
        [pair for pair in found if pair[0].label == DENSE],
        lambda run: run.env_id,
        "no pruned, SET or RigL run at 80 to 90 % beside a dense one of full size",
    )


def rigl_and_set(results: Results, family: str) -> Sides:
    """RigL and SET at 50 to 95 %."""
    runs = (run for run in _main(results, family) if 0.5 <= run.level <= 0.95 + CLOSE)
    found = _scored(results, runs)
    return _sides(
        [pair for pair in found if pair[0].label == "rigl"],
        [pair for pair in found if pair[0].label == "set"],
        _at_level,
        "no RigL run beside a SET run",
    )


def by_distribution(results: Results, family: str) -> Sides:
    """ERK and uniform."""
    found = _scored(results, _sparse(results, family))
    kind = {id(run): results.setting(run, "distribution") for run, _ in found}
    return _sides(
        [pair for pair in found if kind[id(pair[0])] == "erk"],
        [pair for pair in found if kind[id(pair[0])] == "uniform"],
        _all_but("distribution"),
        "no runs that differ in nothing but ERK and uniform",
    )


def by_share(results: Results, family: str) -> Sides:
    """A small actor and a small critic."""
    found = _scored(results, _of_family(results, family))
    shared = [(run, score, run.actor_share) for run, score in found if run.actor_share is not None]
    return _sides(
        [(run, score) for run, score, share in shared if share <= SMALL_SHARE + CLOSE],
        [(run, score) for run, score, share in shared if share >= 1 - SMALL_SHARE - CLOSE],
        _all_but("actor_share"),
        "no run with a small actor beside one with a small critic",
    )


def by_weight_decay(results: Results, family: str) -> Sides:
    """A small weight decay and none."""
    found = [
        (run, score, float(str(results.setting(run, "weight_decay") or 0)))
        for run, score in _scored(results, _of_family(results, family))
    ]
    return _sides(
        [(run, score) for run, score, decay in found if 0 < decay <= SMALL_DECAY * (1 + 1e-9)],
        [(run, score) for run, score, decay in found if decay == 0],
        _all_but("weight_decay"),
        "no runs that differ in nothing but a small weight decay and none",
    )


def by_snr(results: Results, family: str) -> Sides:
    """Log SNR at the highest sparsity and at the lowest, by network."""
    why = f"no {SNR} at two sparsities"
    found: dict[str, list[tuple[RunData, float]]] = defaultdict(list)
    for run in _main(results, family):
        if run.label != EQUAL:
            for network, points in snr_by_network(run.measured).items():
                logs = [math.log(value) for _, value in points if value > 0]
                if logs:
                    found[f"{run.env_id}, {network}"].append((run, fmean(logs)))
    x: dict[str, list[float]] = {}
    y: dict[str, list[float]] = {}
    for stratum, pairs in sorted(found.items()):
        levels = {run.level for run, _ in pairs}
        if len(levels) > 1:
            x[stratum] = _by_seed([p for p in pairs if p[0].level == max(levels)])
            y[stratum] = _by_seed([p for p in pairs if p[0].level == min(levels)])
    return Sides(x, y, why)


def by_noise(results: Results, family: str) -> Sides:
    """What strong noise costs sparse and parameter-equivalent dense networks."""
    found: list[Valued] = []
    for run in _main(results, family):
        by_sigma = returns_by_sigma(run.measured)
        strong = [sigma for sigma in by_sigma if sigma > max(by_sigma) / 2]
        if 0.0 in by_sigma and strong:
            noisy = results.normaliser(run, fmean(by_sigma[sigma] for sigma in strong))
            quiet = results.normaliser(run, by_sigma[0.0])
            if noisy is not None and quiet is not None:
                found.append((run, noisy - quiet))
    return _sides(
        [pair for pair in found if pair[0].label not in (DENSE, EQUAL)],
        [pair for pair in found if pair[0].label == EQUAL],
        _at_level,
        f"no {NOISE} with σ = 0 and more of a sparse run beside a parameter-equivalent dense one",
    )


def _main(results: Results, family: str) -> list[RunData]:
    return [run for run in results.main if run.family == family]


def _of_family(results: Results, family: str) -> list[RunData]:
    return [run for run in results.trained if run.family == family]


def _sparse(results: Results, family: str) -> list[RunData]:
    return [run for run in _of_family(results, family) if run.label not in (DENSE, EQUAL)]


def _scored(results: Results, runs: Iterable[RunData]) -> list[Valued]:
    scored = ((run, results.normaliser(run)) for run in runs)
    return [(run, score) for run, score in scored if score is not None]


def _at_level(run: RunData) -> str:
    return f"{run.env_id} at {percent(run.level)}"


def _all_but(name: str) -> Callable[[RunData], str]:
    def stratum(run: RunData) -> str:
        return f"{_at_level(run)}, {run.label}|{run.variant(name)}"

    return stratum


def _sides(x: list[Valued], y: list[Valued], stratum: Callable[[RunData], str], why: str) -> Sides:
    left, right = _by_stratum(x, stratum), _by_stratum(y, stratum)
    both = sorted(set(left) & set(right))
    names = _short(both)
    return Sides(
        {names[one]: _by_seed(left[one]) for one in both},
        {names[one]: _by_seed(right[one]) for one in both},
        why,
    )


def _short(strata: list[str]) -> dict[str, str]:
    """Names without the text of all settings; numbered where that made them equal."""
    seen: dict[str, int] = defaultdict(int)
    names = {}
    for one in strata:
        head = one.split("|", 1)[0]
        seen[head] += 1
        names[one] = head if seen[head] == 1 else f"{head} ({seen[head]})"
    return names


def _by_stratum(pairs: list[Valued], stratum: Callable[[RunData], str]) -> dict[str, list[Valued]]:
    found: dict[str, list[Valued]] = defaultdict(list)
    for run, value in pairs:
        found[stratum(run)].append((run, value))
    return found


def _by_seed(pairs: list[Valued]) -> list[float]:
    """Mean over methods and settings of each seed that all of them have."""
    kinds: dict[tuple[str, float, str], dict[int, float]] = defaultdict(dict)
    for run, value in pairs:
        kinds[run.label, run.level, run.variant()][run.seed] = value
    seeds = set.intersection(*(set(kind) for kind in kinds.values()))
    return [fmean(kind[seed] for kind in kinds.values()) for seed in sorted(seeds)]
