"""``sb3-sparse study status``: what is missing, what it costs, and what verdicts need."""

from __future__ import annotations

import re
import sys

import pytest
from study_support import archived, study

from sb3_sparse.cli.study import status
from sb3_sparse.pages.numbers import short
from sb3_sparse.studies.cell import Cell
from sb3_sparse.zoo.archive import Archive
from sb3_sparse.zoo.spec import RunSpec

SEEDS = 5
SPENT = {"set": 36.0, "dense": 18.0}  # seconds, so a seed of both takes 0.015 hours
APART = {"set": (480.0, 470.0, 490.0), "dense": (60.0, 50.0, 70.0)}
OPEN = {"set": (100.0, 480.0, 250.0, 400.0), "dense": (40.0, 420.0, 190.0, 340.0)}


@pytest.fixture
def told(tmp_path, capsys):
    """Makes an archive of seeds with these scores, and gives what ``study status`` prints."""

    def tell(scores, *others, **changed):
        made = study(
            tmp_path,
            title="Set beside dense",
            runs=[{"method": "set", "sparsity": 0.9}, {"method": "dense", "match_params": 0.9}],
            scales={"smoke": {"seeds": SEEDS, "n_timesteps": 2000, "eval_freq": 2000}},
            **changed,
        )
        lines = [
            archived(cell, SPENT[cell.run.method], scores[cell.run.method][cell.run.seed])
            for cell in made.cells
            if cell.run.seed < len(scores[cell.run.method])
        ]
        archive = tmp_path / "runs.jsonl"
        Archive(archive).add([*lines, *others])
        status(str(tmp_path / "mine.yml"), "smoke", tmp_path / "none", archive)
        return capsys.readouterr().out.splitlines()

    return tell


def finding(lines):
    (line,) = [line for line in lines if line.startswith("  equal-parameters")]
    return line


def test_what_is_left_costs_what_its_like_took(told):
    lines = told({"set": APART["set"], "dense": APART["dense"][:2]})
    assert lines[0] == "Set beside dense, scale smoke: 10 runs"
    # 2 * 36 + 3 * 18 seconds
    assert "  CartPole-v1: 5 of 10; left 5 runs, 0.035 core hours" in lines
    assert any(
        line.startswith("Core hours are the processor's seconds of training") for line in lines
    )
    assert not any(line.startswith("Left in all") for line in lines)  # of one environment


def test_environments_add_up_and_guesses_are_told(told):
    """A run of 1,000 steps of another method took 90 s, so each of 2,000 takes 180 s."""
    common = {"algo": "dqn", "env_id": ["CartPole-v1", "Acrobot-v1"]}
    none = {"set": (), "dense": ()}
    cell = Cell(RunSpec("dqn", "CartPole-v1", method="static", sparsity=0.5, n_timesteps=1000))
    lines = told(none, archived(cell, 90.0), common=common)
    assert (
        "  CartPole-v1: 0 of 10; left 10 runs, 0.5 core hours; 10 by other methods in "
        + ("their environment")
        in lines
    )
    assert "  Acrobot-v1: 0 of 10; left 10 runs, 0.5 core hours; 10 by other environments" in lines
    assert "Left in all: 20 runs, 1 core hour" in lines
    assert not any("Findings" in line for line in lines)


def test_a_task_without_a_scale_is_named_with_the_cure(told):
    common = {"algo": "sac", "env_id": ["MountainCarContinuous-v0"]}
    (line,) = [line for line in told(APART, common=common) if line.startswith("No scale")]
    assert "SAC on classic control, MountainCarContinuous-v0: no run of the dense network" in line
    assert line.endswith(
        "reference_returns in a study's file (docs/studies.md) give a task a scale"
    )
    given = {"MountainCarContinuous-v0": [0, 500]}
    lines = told(APART, common=common, reference_returns=given)
    assert not any(line.startswith("No scale") for line in lines)
    assert "supported" in finding(lines)


def test_without_a_timed_run_the_cost_is_unknown(told):
    lines = told({"set": (), "dense": ()})
    unknown = "left 10 runs, core hours unknown; no run of DQN has been timed yet"
    assert f"  CartPole-v1: 0 of 10; {unknown}" in lines
    assert not any(line.startswith("Core hours are") for line in lines)


def test_an_open_verdict_says_how_many_runs_would_decide_it_and_what_they_cost(told):
    line = finding(told(OPEN))
    match = re.fullmatch(
        r"  equal-parameters: not enough data, \+\S+ \[-\S+; \S+\], 4 seeds; about (\d+) would "
        r"decide if the effect stays: (\d+) runs, (\S+) core hours \(the study has 5 seeds\)",
        line,
    )
    assert match, line
    seeds, runs, hours = match.groups()
    assert int(seeds) > SEEDS
    assert int(runs) == 2 * (int(seeds) - 4)
    assert hours == short(0.015 * (int(seeds) - 4))


def test_too_few_seeds_for_an_interval_say_how_many_it_takes(told):
    line = finding(told({"set": APART["set"][:2], "dense": APART["dense"][:1]}))
    # a seed of SET and two of dense: 36 + 2 * 18 seconds
    assert line == (
        "  equal-parameters: not enough data; 3 seeds are the least: 3 runs, 0.02 core hours"
    )


def test_a_verdict_needs_nothing(told):
    line = finding(told(APART))
    assert re.fullmatch(r"  equal-parameters: supported, \+0.93 \[\S+; \S+\], 3 seeds", line)


def test_an_effect_that_no_number_of_seeds_decides_says_so(told):
    mirrored = {"set": (100.0, 200.0, 300.0), "dense": (300.0, 200.0, 100.0)}
    assert finding(told(mirrored)).endswith("3 seeds; more than 1,000 would be needed")


def test_without_the_extra_for_reports_only_verdicts_are_missing(told, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("sb3_sparse.report")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rliable", None)
    lines = told(APART)
    assert "  CartPole-v1: 6 of 10; left 4 runs, 0.03 core hours" in lines
    assert lines[-1].startswith("No verdicts: reports on runs needs sb3-sparse[report]: pip")
