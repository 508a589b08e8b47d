"""Four verdicts on the runs of the archive, computed again from its JSON with NumPy and scipy.

Only the fixture ``judged`` calls the package; all other numbers come from the JSON, so an error in
choosing, scoring, averaging or resampling runs shows as another number.
"""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from statistics import fmean

import numpy as np
import pytest
from scipy.stats import norm, t, trim_mean

from sb3_sparse.report import Results, judge, read_runs
from sb3_sparse.studies import Study, status_of
from sb3_sparse.zoo import Archive

ARCHIVE = Path(__file__).parents[2] / "docs/results/runs.jsonl"
pytestmark = pytest.mark.skipif(
    not ARCHIVE.is_file(), reason="a source distribution has no archive of runs"
)
RANDOM_AND_SOLVED = {"CartPole-v1": (22.0, 475.0), "Acrobot-v1": (-499.0, -100.0)}
SEEDS, RESAMPLES, REPEATS = (0, 1, 2), 2000, 200
MOVING = ("prune", "set", "rigl")


def lines() -> list[dict]:
    """DQN's runs of 25,000 steps, with no setting of their own and no measure during training."""
    latest = {}
    for text in ARCHIVE.read_text().splitlines():
        line = json.loads(text)
        latest[line["address"]] = line
    return [line for line in latest.values() if is_wanted(line)]


def is_wanted(line: dict) -> bool:
    run, settings = line["record"]["run"], line["record"]["settings"]
    own = [run.get(name) for name in ("hyperparams", "distribution", "conf_file", "entry")]
    return (
        (run["algo"], settings["n_timesteps"], run["eval_freq"]) == ("dqn", 25_000, 2_500)
        and run["env_id"] in RANDOM_AND_SOLVED
        and run["seed"] in SEEDS
        and not any(own)
        and not {"snr.csv", "plasticity.csv"} & set(line["measured"])
    )


def of(line: dict) -> tuple[str, float]:
    """The method, ``"equal"`` for the dense network of equal size, and the sparsity."""
    run = line["record"]["run"]
    if run["match_params"] is not None:
        return "equal", run["match_params"]
    return run["method"], run["sparsity"] or 0.0


def normalised(line: dict, value: float) -> float:
    low, high = RANDOM_AND_SOLVED[line["record"]["run"]["env_id"]]
    return (value - low) / (high - low)


def score(line: dict) -> float:
    """The normalised mean over the last tenth of the evaluations."""
    means = [fmean(episodes) for episodes in line["evaluations"]["returns"]]
    assert len(means) == 10  # so the last tenth is the last one
    return normalised(line, means[-1])


def cost_of_noise(line: dict) -> float:
    """What the upper half of the strengths of noise costs, normalised."""
    rows = list(csv.DictReader(io.StringIO(line["measured"]["robustness.csv"])))
    at = {
        sigma: fmean(float(row["return"]) for row in rows if float(row["sigma"]) == sigma)
        for sigma in {float(row["sigma"]) for row in rows}
    }
    strong = [at[sigma] for sigma in at if sigma > max(at) / 2]
    assert len(strong) == 2  # 1.5 and 2
    return normalised(line, fmean(strong)) - normalised(line, at[0.0])


def table(given, value, methods, levels, per_level=True) -> np.ndarray:
    """Means over the methods, a row for each seed.

    A column for each environment and sparsity, or for each environment alone.
    """
    columns = []
    for env_id in RANDOM_AND_SOLVED:
        for together in [[level] for level in levels] if per_level else [levels]:
            column = []
            for seed in SEEDS:
                found = [
                    value(line)
                    for line in given
                    if line["record"]["run"]["env_id"] == env_id
                    and line["record"]["run"]["seed"] == seed
                    and of(line) in {(method, level) for method in methods for level in together}
                ]
                assert len(found) == len(methods) * len(together)
                column.append(fmean(found))
            columns.append(column)
    return np.array(columns).T


def sides_of(key: str) -> tuple[np.ndarray, np.ndarray]:
    """Both sides of a finding, each of shape ``[seeds, strata]``."""
    given = lines()
    if key == "equal-parameters":
        levels = [0.5, 0.9, 0.95, 0.99]
        return table(given, score, MOVING, levels), table(given, score, ["equal"], levels)
    if key == "no-loss":
        return table(given, score, MOVING, [0.9], False), table(given, score, ["dense"], [0.0])
    if key == "rigl-set":
        levels = [0.5, 0.9, 0.95]
        return table(given, score, ["rigl"], levels), table(given, score, ["set"], levels)
    noisy = [line for line in given if "robustness.csv" in line["measured"]]
    levels = [0.5, 0.9]
    sparse = table(noisy, cost_of_noise, ["set", "rigl"], levels)
    return sparse, table(noisy, cost_of_noise, ["equal"], levels)


def statistic(key: str, values: np.ndarray) -> np.ndarray:
    """The mean of the middle half, or for noise the mean, over the last two axes."""
    flat = values.reshape(*values.shape[:-2], -1)
    return flat.mean(axis=-1) if key == "noise" else trim_mean(flat, 0.25, axis=-1)


def region(key: str, reference: float) -> tuple[float, float]:
    """The effects for which the finding holds."""
    if key == "no-loss":
        return -0.05 * reference, np.inf
    if key == "rigl-set":
        return -0.1 * reference, 0.1 * reference
    return 0.0, np.inf


def interval(key: str, x: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    """Ends of the 95 % interval: percentiles of a bootstrap within strata, widened as Hesterberg.

    Within each stratum of each side, seeds are drawn with replacement. An end is moved out by
    sqrt(n / (n - 1)), and by Student's t to the normal distribution.
    """
    random = np.random.default_rng(seed)
    drawn = [
        np.take_along_axis(side[None], random.integers(len(side), size=(RESAMPLES, *side.shape)), 1)
        for side in (x, y)
    ]
    effects = statistic(key, drawn[0]) - statistic(key, drawn[1])
    effect = statistic(key, x) - statistic(key, y)
    n, strata = x.shape
    widened = np.sqrt(n / (n - 1)) * t.ppf(0.975, strata * 2 * (n - 1)) / norm.ppf(0.975)
    return effect + widened * (np.percentile(effects, [2.5, 97.5]) - effect)


@pytest.fixture(scope="module")
def judged():
    """The package's verdicts on these seeds, by finding."""
    archive = Archive(ARCHIVE).read()
    found = {}
    for name, keys in (
        ("classic_control", ("equal-parameters", "no-loss", "rigl-set")),
        ("noise", ("noise",)),
    ):
        statuses = [
            status_of(cell, Path("nowhere"), archive)
            for cell in Study.read(name, "small").cells
            if cell.run.seed in SEEDS
        ]
        runs, out = read_runs([], {one.folder.path: one.archived for one in statuses})
        assert (len(runs), out) == (len(statuses), [])
        for one in judge(Results(tuple(runs))):
            if one.finding.key in keys:
                found[one.finding.key] = one
    return found


KEYS = {"equal-parameters": 8, "no-loss": 2, "rigl-set": 6, "noise": 4}


@pytest.mark.parametrize("key", KEYS)
def test_a_verdict_is_that_of_plain_numpy(key, judged):
    one = judged[key]
    x, y = sides_of(key)
    assert x.shape == y.shape == (one.seeds, one.comparisons) == (len(SEEDS), KEYS[key])
    effect = statistic(key, x) - statistic(key, y)
    assert one.effect == pytest.approx(effect, abs=1e-12)

    # The package's interval is one of those that a bootstrap gives.
    ends = np.array([interval(key, x, y, seed) for seed in range(REPEATS)])
    middle, error = ends.mean(axis=0), ends.std(axis=0, ddof=1)
    allowed = 4 * error * np.sqrt(1 + 1 / REPEATS)
    assert np.all(allowed < 0.15 * (middle[1] - middle[0]))  # or nothing is compared
    assert np.all(np.abs([one.low, one.high] - middle) <= allowed)

    low, high = region(key, statistic(key, y))
    if middle[0] > low and middle[1] < high:
        verdict = "supported"
    elif middle[1] < low or middle[0] > high:
        verdict = "contradicted"
    else:
        verdict = "not enough data"
    assert one.verdict == verdict
