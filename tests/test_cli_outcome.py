"""How ``sb3-sparse train`` ends, and what it shows on a terminal meanwhile."""

from __future__ import annotations

import io
import json
import re
import time
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from stable_baselines3 import DQN, PPO

from sb3_sparse.cli import outcome as ending
from sb3_sparse.cli.progress.train import TrainingProgress, sparkline
from sb3_sparse.zoo import Outcome, RunSpec, train
from sb3_sparse.zoo.watch import TrainingLog

RUN = RunSpec(
    algo="sac",
    env_id="Pendulum-v1",
    n_timesteps=300,
    eval_freq=100,
    eval_episodes=1,
    hyperparams={"net_arch": [24, 24], "batch_size": 16, "update_interval": 20},
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> tuple[Outcome, str]:
    """A run, and what a terminal of 80 columns got."""
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=80, highlight=False, markup=False)
    progress = TrainingProgress(console, "Training it")
    found = train(RUN, tmp_path_factory.mktemp("logs"), watch=progress)
    return found, file.getvalue()


def lines_of(found: Outcome, capsys: pytest.CaptureFixture[str]) -> list[str]:
    ending.tell(found)
    return capsys.readouterr().out.splitlines()


def numbers(line: str) -> list[int]:
    return [int(number.replace(",", "")) for number in re.findall(r"\d[\d,]*", line)]


def test_it_ends_with_returns_sizes_times_and_three_commands(trained, capsys):
    found, _ = trained
    lines = lines_of(found, capsys)
    parameters, in_c, action = (
        next(line for line in lines if line.startswith(head))
        for head in ("Parameters, all networks", "Policy in C, bytes", "An action, microseconds")
    )
    # actor 3-24-24 with two heads of one, each of two critics 4-24-24-1, and the biases of all
    dense = 3 * 24 + 24 * 24 + 2 * 24 + 50 + 2 * (4 * 24 + 24 * 24 + 24 + 49)
    record = json.loads((found.folder / "sparsity.json").read_text())
    assert numbers(parameters) == [record["total"]["parameters"], dense]
    assert numbers(in_c)[1] == 4 * (3 * 24 + 24 * 24 + 24 + 49)  # without the log_std head
    assert re.search(r"\d in C, \d+\S* by predict, one thread", action)
    assert f"Learning curve: {found.folder / 'curve.png'}" in lines
    assert (found.folder / "curve.png").is_file()
    assert [line.split()[:2] for line in lines[-3:]] == [
        ["sb3-sparse", "enjoy"],
        ["sb3-sparse", "export"],
        ["sb3-sparse", "study"],
    ]
    assert all(str(found.folder) in line for line in lines[-3:-1])


def test_without_a_compiler_the_table_says_why_and_goes_on(trained, capsys, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    lines = lines_of(trained[0], capsys)
    (why,) = (line for line in lines if line.startswith("No size and time in C:"))
    assert "no-such-compiler" in why
    assert lines[-1] == "sb3-sparse study list"


def test_a_run_without_evaluations_says_that_it_has_no_curve(trained, capsys):
    (trained[0].folder / "evaluations.npz").rename(trained[0].folder / "kept.npz")
    try:
        lines = lines_of(trained[0], capsys)
    finally:
        (trained[0].folder / "kept.npz").rename(trained[0].folder / "evaluations.npz")
    (why,) = (line for line in lines if line.startswith("No learning curve, no best policy:"))
    assert "--eval-freq" in why


@pytest.mark.parametrize(("last", "best", "named"), [(-5.0, -4.0, True), (-4.0, -5.0, False)])
def test_the_commands_take_the_policy_with_the_greater_return(trained, capsys, last, best, named):
    found, _ = trained
    of_last, of_best = found.results
    results = (replace(of_last, mean_return=last), replace(of_best, mean_return=best))
    lines = lines_of(replace(found, results=results), capsys)
    assert [" --best" in line for line in lines[-3:]] == [named, named, False]


def test_large_policies_are_not_compiled(trained, capsys, monkeypatch):
    monkeypatch.setattr(ending, "SMALL", 700)
    lines = lines_of(trained[0], capsys)
    assert any(line.startswith("Not exported and timed") for line in lines)
    assert not any("predict" in line for line in lines)


def test_the_critics_do_not_count_for_what_is_too_large_to_export(trained, capsys, monkeypatch):
    monkeypatch.setattr(ending, "SMALL", 1000)  # the actor has 746 parameters if dense
    assert any("by predict" in line for line in lines_of(trained[0], capsys))


def test_whatever_fails_at_the_end_fails_no_run(trained, capsys, monkeypatch):
    def broken(*_: object) -> Path:
        raise RuntimeError("no ink")

    monkeypatch.setattr("sb3_sparse.zoo.curve.write_curve", broken)
    lines = lines_of(trained[0], capsys)
    assert "No learning curve: RuntimeError: no ink" in lines
    assert lines[-1] == "sb3-sparse study list"


def test_a_terminal_of_80_columns_shows_the_bar_and_a_line_below_it(trained):
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", trained[1])
    assert "Training it" in shown
    assert re.search(r"300/300 steps, time left 0:00:00", shown)
    last = re.findall(
        r"training return -\d+\.\d, sparsity \d\d\.\d\d%, \d+ steps/s  ([▁-█]+)", shown
    )[-1]
    assert len(last) == 3  # evaluations
    assert re.search(r"evaluated at step 200: return", shown)
    assert "of 300 steps" not in shown  # the lines that stand for the view elsewhere


def test_a_row_of_blocks_goes_from_the_lowest_to_the_highest():
    assert sparkline([]) == ""
    assert sparkline([5.0, 5.0]) == "██"
    assert sparkline([0.0, 7.0, 3.0]) == "▁█▄"
    assert sparkline([100.0, 0.0, 1.0], width=2) == "▁█"


def test_without_a_terminal_lines_say_the_time_left(tmp_path):
    file = io.StringIO()
    console = Console(file=file, width=80, highlight=False, markup=False)
    train(RUN, tmp_path, watch=TrainingProgress(console, "Training it"))
    lines = [line for line in file.getvalue().splitlines() if "of 300 steps" in line]
    assert len(lines) == 10
    for line in lines[:3]:  # at most 90 steps, and the 100 before learning_starts say nothing
        assert re.search(r"sparsity \d\d\.\d\d%, \d+ steps/s$", line)
    for line in lines[3:-1]:
        assert re.search(r"sparsity \d\d\.\d\d%, \d+ steps/s, \d:\d\d:\d\d left$", line)
    assert re.search(
        r"300 of 300 steps, training return \S+, sparsity \S+%, \d+ steps/s$", lines[-1]
    )


class Clocked(TrainingLog):
    """Takes a millisecond a step until learning starts, and a second from then on."""

    def _on_step(self) -> bool:
        collecting = self.num_timesteps <= getattr(self.model, "learning_starts", 0)
        self.clock.append(self.clock[-1] + (10**6 if collecting else 10**9))
        super()._on_step()
        self.left.append(self.seconds_left())
        return True


@pytest.mark.parametrize(
    ("model", "unknown"),
    [
        (lambda: DQN("MlpPolicy", "CartPole-v1", learning_starts=50, train_freq=1), 51),
        (lambda: PPO("MlpPolicy", "CartPole-v1", n_steps=32, batch_size=32, n_epochs=1), 32),
    ],
)
def test_the_time_left_goes_by_the_speed_of_learning(monkeypatch, model, unknown):
    log = Clocked(say=lambda line: None)
    log.clock, log.left = [0], []
    monkeypatch.setattr(time, "time_ns", lambda: log.clock[-1])
    model().learn(96, callback=log)
    assert log.left[:unknown] == [None] * unknown
    assert log.left[unknown:] == pytest.approx([96 - step for step in range(unknown + 1, 97)])
