"""Each verdict on run folders whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_sparse.errors import ConfigError
from sb3_sparse.report import FINDINGS, Results, Verdict, judge, read_runs
from sb3_sparse.report.findings import GREATER as GREATER_REGION
from sb3_sparse.report.statistics import Estimate

SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "not enough data"


def verdict(folders, key):
    runs, out = read_runs(folders.made)
    assert not out
    found = [one for one in judge(Results(tuple(runs))) if one.finding.key == key]
    assert len(found) == 1
    return found[0]


def seeds(folders, count, score, **given):
    for seed in range(count):
        noise = float(np.random.default_rng(seed + 100).normal(0, 2))
        folders.add(seed=seed, score=score + noise, **given)


DENSE, EQUAL = {"method": "dense", "sparsity": None}, {"method": "dense", "sparsity": None}
EQUAL = {**EQUAL, "match": 0.9}


def pair(key, better, worse, folders, count):
    """Folders in which the first side scores ``better`` and the other ``worse``."""
    match key:
        case "equal-parameters":
            seeds(folders, count, better)
            seeds(folders, count, worse, **EQUAL)
        case "no-loss":
            seeds(folders, count, better)
            seeds(folders, count, worse, **DENSE)
        case "rigl-set":
            seeds(folders, count, better)
            seeds(folders, count, worse, method="set")
        case "erk":
            seeds(folders, count, better)
            seeds(folders, count, worse, policy={"distribution": "uniform"})
        case "weight-decay":
            seeds(folders, count, better, policy={"weight_decay": 1e-6})
            seeds(folders, count, worse)
        case "critic":
            seeds(folders, count, better, share=0.1, policy={"actor_share": 0.1})
            seeds(folders, count, worse, share=0.9, policy={"actor_share": 0.9})
        case "snr":
            for seed in range(count):
                low, high = better * (1 + 0.01 * seed), worse * (1 + 0.01 * seed)
                folders.add(seed=seed, snr={"snr/q_net": low, "snr/q_net/active": 1.0})
                folders.add("dense", None, seed, snr={"snr/q_net": high})
        case "noise":
            for seed in range(count):
                score = 400.0 + seed
                for side, cost in (({}, better), (EQUAL, worse)):
                    kept = score - 500 + cost
                    noise = {0.0: score, 1.0: score - 1, 2.0: kept}
                    folders.add(seed=seed, score=score, noise=noise, **side)


HIGH, LOW = 450.0, 300.0
GREATER = ["equal-parameters", "no-loss", "erk", "weight-decay", "critic", "noise"]


@pytest.mark.parametrize("key", GREATER)
def test_a_clear_gain_supports_and_a_clear_loss_contradicts(folders, tmp_path, key):
    pair(key, HIGH, LOW, folders, 4)
    gain = verdict(folders, key)
    assert gain.verdict == SUPPORTED
    assert gain.effect == pytest.approx(150 / 453, abs=0.02)  # CartPole's scale: 22 to 475
    assert gain.low <= gain.effect + 1e-12
    assert gain.effect <= gain.high + 1e-12
    assert gain.seeds == 4
    worse = type(folders)(tmp_path / "worse")
    pair(key, LOW, HIGH, worse, 4)
    assert verdict(worse, key).verdict == CONTRADICTED


@pytest.mark.parametrize("key", [*GREATER, "rigl-set", "snr"])
def test_two_seeds_give_no_verdict(folders, key):
    pair(key, HIGH, LOW, folders, 2)
    found = verdict(folders, key)
    assert found.verdict == UNDECIDED
    assert found.effect is None
    assert "3 seeds" in found.remark


@pytest.mark.parametrize("finding", FINDINGS, ids=lambda finding: finding.key)
def test_without_runs_each_finding_says_what_is_missing(folders, finding):
    folders.add("static", 0.9)
    found = verdict(folders, finding.key)
    assert (found.verdict, found.effect) == (UNDECIDED, None)
    assert found.remark


def test_a_task_of_negative_returns_counts_once_it_has_a_scale(folders):
    for method in ("rigl", "set"):
        seeds(folders, 4, -300.0, method=method, env_id="Maze-v0")
    seeds(folders, 4, -200.0, **DENSE, env_id="Maze-v0")
    without = verdict(folders, "rigl-set")
    assert (without.verdict, without.has_data) == (UNDECIDED, False)
    assert "no scale: DQN on other tasks, Maze-v0: the dense network's mean" in without.remark
    runs, _ = read_runs(folders.made)
    results = Results(tuple(runs), references={"Maze-v0": (-500.0, -100.0)})
    found = {one.finding.key: one for one in judge(results)}
    assert found["rigl-set"].verdict == SUPPORTED
    assert found["no-loss"].verdict == CONTRADICTED
    assert found["no-loss"].effect == pytest.approx(-100 / 400)


def test_equal_scores_support_that_rigl_is_as_good_as_set(folders):
    pair("rigl-set", 400.0, 400.0, folders, 5)
    assert verdict(folders, "rigl-set").verdict == SUPPORTED


@pytest.mark.parametrize("scores", [(HIGH, LOW), (LOW, HIGH)])
def test_a_clear_difference_either_way_contradicts_it(folders, scores):
    pair("rigl-set", *scores, folders, 5)
    assert verdict(folders, "rigl-set").verdict == CONTRADICTED


def test_a_difference_drowned_in_noise_is_not_decided(folders):
    for seed, score in enumerate((100.0, 480.0, 250.0)):
        folders.add("rigl", seed=seed, score=score)
        folders.add("set", seed=seed, score=580.0 - score)
    found = verdict(folders, "rigl-set")
    assert found.verdict == UNDECIDED
    assert found.effect is not None


def test_a_loss_within_the_margin_is_no_loss(folders):
    pair("no-loss", 396.0, 400.0, folders, 5)
    found = verdict(folders, "no-loss")
    assert found.verdict == SUPPORTED
    # 5 % of about (400 - 22) / (475 - 22), CartPole's scale
    assert found.region.low == pytest.approx(-0.05 * 378 / 453, rel=0.02)
    assert found.holds == "> -0.042"
    assert found.needed is None


def test_snr_falls_or_rises_with_sparsity(folders, tmp_path):
    pair("snr", 0.1, 0.2, folders, 4)
    falls = verdict(folders, "snr")
    assert falls.verdict == SUPPORTED
    assert falls.effect == pytest.approx(np.log(0.5))
    rises = type(folders)(tmp_path / "rises")
    pair("snr", 0.2, 0.1, rises, 4)
    assert verdict(rises, "snr").verdict == CONTRADICTED


def test_static_counts_for_no_finding_about_sparse_training(folders):
    seeds(folders, 4, HIGH, method="static")
    seeds(folders, 4, LOW, **EQUAL)
    assert verdict(folders, "equal-parameters").verdict == UNDECIDED


def test_a_setting_beside_the_compared_one_must_be_the_same(folders):
    seeds(folders, 4, HIGH, policy={"weight_decay": 1e-6}, settings={"batch_size": 64})
    seeds(folders, 4, LOW)
    assert verdict(folders, "weight-decay").verdict == UNDECIDED


def test_tasks_are_strata(folders):
    for env_id, score in (("CartPole-v1", 400.0), ("Acrobot-v1", -120.0)):
        seeds(folders, 3, score, env_id=env_id)
        seeds(folders, 3, score - 60, env_id=env_id, **EQUAL)
    found = verdict(folders, "equal-parameters")
    assert (found.verdict, found.comparisons, found.seeds) == (SUPPORTED, 2, 3)


def test_an_open_verdict_tells_how_many_seeds_would_decide_it(folders):
    for seed, score in enumerate((100.0, 480.0, 250.0, 400.0)):
        folders.add("rigl", seed=seed, score=score)
        folders.add("dense", None, seed=seed, score=score - 60, match=0.9)
    found = verdict(folders, "equal-parameters")
    assert found.verdict == UNDECIDED
    assert found.needed > found.seeds


@pytest.mark.parametrize(
    ("effect", "low", "high", "share"),
    [
        # Student's t of 6 degrees of freedom is 2.447, by hand from a table, and sqrt(4/3) widens.
        (0.2, -0.2, 0.6, 0.5),  # its low end must rise to 0
        (-0.1, -0.3, 0.3, 0.25),  # its high end must fall to 0
    ],
)
def test_seeds_needed_are_those_whose_interval_ends_at_the_edge(effect, low, high, share):
    t = {4: 2.447, 9: 2.120, 10: 2.101, 32: 1.999, 33: 1.998}

    def reach(seeds):
        return t[seeds] * np.sqrt(seeds / (seeds - 1)) / np.sqrt(seeds)

    found = GREATER_REGION.needed(Estimate(effect, low, high, 4))
    assert found in t
    assert reach(found) <= share * reach(4) * 1.001
    assert reach(found - 1) > share * reach(4) * 0.999


def test_an_effect_at_the_edge_needs_more_seeds_than_anyone_has():
    assert GREATER_REGION.needed(Estimate(0.0, -0.2, 0.2, 4)) is None
    assert GREATER_REGION.needed(Estimate(1e-4, -0.2, 0.2, 4)) is None


def test_the_sides_name_the_runs_that_they_are_made_of(folders):
    seeds(folders, 3, HIGH)
    seeds(folders, 3, LOW, **EQUAL)
    taken = set(folders.made)
    seeds(folders, 3, HIGH, method="static")
    seeds(folders, 3, HIGH, sparsity=0.5)  # beside no dense network of equal size
    runs, _ = read_runs(folders.made)
    (finding,) = [one for one in FINDINGS if one.key == "equal-parameters"]
    results = Results(tuple(runs))
    (family,) = results.families()
    assert {run.folder for run in finding.sides(results, family).runs} == taken


def test_the_runs_of_snr_are_those_of_the_highest_and_the_lowest_sparsity(folders):
    pair("snr", 0.1, 0.2, folders, 3)
    taken = set(folders.made)
    for seed in range(3):
        folders.add(sparsity=0.5, seed=seed, snr={"snr/q_net": 0.15, "snr/q_net/active": 1.0})
    runs, _ = read_runs(folders.made)
    (finding,) = [one for one in FINDINGS if one.key == "snr"]
    results = Results(tuple(runs))
    assert {run.folder for run in finding.sides(results, *results.families()).runs} == taken


def test_only_the_findings_that_are_asked_for_are_judged(folders):
    folders.add("static", 0.9)
    runs, _ = read_runs(folders.made)
    found = judge(Results(tuple(runs), findings=("noise", "erk")))
    assert [one.finding.key for one in found] == ["erk", "noise"]
    with pytest.raises(ConfigError, match=r"unknown finding 'nois' \(did you mean 'noise'"):
        judge(Results(tuple(runs), findings=("nois",)))


def test_an_effect_shows_on_which_side_of_nothing_its_ends_lie():
    shown = Verdict(FINDINGS[0], "DQN", UNDECIDED, -0.224, -0.458, 0.00004).shown
    assert shown == "-0.22 [-0.46; +0.00004]"
    assert Verdict(FINDINGS[0], "", UNDECIDED).shown == ""


@pytest.mark.parametrize("pair", [(-60.0, -500.0), (1.0, 1.0), (0.0, float("nan"))])
def test_reference_returns_that_are_no_scale_are_rejected(folders, pair):
    folders.add("rigl", 0.9, 0)
    runs, _ = read_runs(folders.made)
    results = Results(tuple(runs), references={"CartPole-v1": pair})
    with pytest.raises(ConfigError, match="must be the greater, got .* for CartPole-v1"):
        judge(results)
