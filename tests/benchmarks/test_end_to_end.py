"""The benchmark of whole trainings: what it measures, and what it refuses."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import pytest
from stable_baselines3.common.atari_wrappers import AtariWrapper

BENCHMARKS = Path(__file__).parent.parent.parent / "benchmarks"


@pytest.fixture
def end_to_end(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import end_to_end

    return end_to_end


def run(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(BENCHMARKS / "end_to_end.py"), *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_case_is_measured_from_end_to_end(tmp_path, end_to_end, monkeypatch, capsys):
    file = tmp_path / "rows.csv"
    one_round = ["--rounds", 1, "--seconds", 0.01]
    case = ["--cases", "a2c-8@CartPole-v1", "--activation", "silu", "--sparsity", 0.5]
    done = run(*case, *one_round, "--csv", file)
    assert done.returncode == 0, done.stderr
    assert " of 2 slower than stock" in done.stdout
    with file.open(newline="") as rows:
        stock, plugin, ours = csv.DictReader(rows)
    assert [row["contender"] for row in (stock, plugin, ours)] == ["stock", "plug-in", "ours"]
    assert [row["sparsity"] for row in (stock, plugin, ours)] == ["", "0.5", "0.5"]
    assert float(stock["ratio"]) == 1
    assert int(stock["steps"]) == int(plugin["steps"]) == int(ours["steps"])
    assert int(stock["steps"]) >= 10
    for row in (stock, plugin, ours):
        step = 1e6 / float(row["steps_per_second"])
        assert 0 < float(row["act_us"]) < float(row["rollout_us"]) < step
    rates = float(ours["steps_per_second"]) / float(stock["steps_per_second"])
    assert float(ours["ratio"]) == pytest.approx(rates)
    monkeypatch.setattr(sys, "argv", ["end_to_end.py", "--table", str(file)])
    end_to_end.main()
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 3
    assert printed[2].startswith("| a2c-8 silu | CartPole-v1 | 50% | ")
    ratios = f" | {float(plugin['ratio']):.2f} | **{float(ours['ratio']):.2f}** | "
    assert ratios in printed[2]


def test_the_table_has_a_line_for_each_sparsity_and_method(end_to_end, capsys, tmp_path):
    row = dict.fromkeys(end_to_end.FIELDS, 1.0) | dict(env="E-v0", activation="")
    rows = [
        dict(row, case="tqc-8@E-v0", contender="stock", sparsity=""),
        dict(row, case="tqc-8@E-v0", contender="plug-in, rigl", sparsity=0.9, ratio=2.0),
        dict(row, case="sac-8", contender="stock", sparsity=""),
        dict(row, case="sac-8", contender="sbx", sparsity="", ratio=1.5),
        dict(row, case="sac-8", contender="plug-in", sparsity=0.9, ratio=2.0),
        dict(row, case="sac-8", contender="ours", sparsity=0.9, ratio=4.0, rollout_ratio=0.75),
        dict(row, case="sac-8", contender="ours", sparsity=0.0, ratio=1.25),
    ]
    path = tmp_path / "rows.csv"
    with end_to_end.appending(path, end_to_end.FIELDS) as write:
        for one in rows:
            write(one)
    end_to_end.table(path)
    rate, same = "1", "1.00"
    assert capsys.readouterr().out.splitlines()[2:] == [
        f"| tqc-8 | E-v0 | 90%, rigl | {rate} |  | {rate} |  |  | 2.00 |  | {same} | {same} |",
        f"| sac-8 | E-v0 | 90% | {rate} | {rate} | {rate} | {rate} | 1.50 | 2.00 | **4.00** "
        f"| 0.75 | {same} |",
        f"| sac-8 | E-v0 | 0% | {rate} | {rate} |  | {rate} | 1.50 |  | **1.25** "
        f"| {same} | {same} |",
    ]


@pytest.mark.parametrize("algo", ["ppo", "a2c", "sac", "dqn", "tqc", "qrdqn", "crossq"])
def test_our_gradient_steps_are_fused_while_they_are_measured(end_to_end, algo):
    import learner

    env = "CartPole-v1" if algo.endswith("dqn") else "Pendulum-v1"
    spec = dict(kind="ours", algo=algo, net="8", env=env, activation=None, rollout=64)
    spec |= dict(sparsity=0.9, method=None)
    model = learner.build(spec)
    assert type(model).__module__.startswith("sb3_sparse.")
    times = learner.Learner(spec, model).learn(64)
    assert times["train"] > 0 < times["act"]
    assert model.why_not_fused() is None


def test_what_has_no_class_of_ours_is_the_plug_in_alone(end_to_end):
    import learner

    assert learner.algorithm("ours", "TRPO") is None
    assert learner.algorithm("plug-in", "TRPO").__module__.startswith("sb3_contrib.")


def test_medians_and_ratios_are_taken_round_by_round(end_to_end):
    stock = [
        dict(
            steps=10, seconds=1.0, elapsed=1.0, train=0.8, act=0.1
        ),  # 10 a second; rollout 20 ms, action 10
        dict(steps=10, seconds=2.0, elapsed=2.0, train=1.0, act=0.2),  # 5; 100, 20
        dict(steps=10, seconds=4.0, elapsed=4.0, train=2.0, act=0.4),  # 2.5; 200, 40
    ]
    ours = [
        dict(steps=10, seconds=0.5, elapsed=0.5, train=0.4, act=0.05),  # 20; 10, 5
        dict(steps=10, seconds=0.5, elapsed=1.0, train=0.1, act=0.3),  # 20; 40, 30
        dict(steps=10, seconds=5.0, elapsed=6.25, train=2.0, act=1.0),  # 2; 300, 100
    ]
    found = end_to_end.summary(ours, stock)
    assert found["steps_per_second"] == pytest.approx(20)
    assert (found["lowest"], found["highest"]) == pytest.approx((2, 20))
    assert found["ratio"] == pytest.approx(2)  # of 2, 4 and 0.8
    assert (found["ratio_lowest"], found["ratio_highest"]) == pytest.approx((0.8, 4))
    assert found["rollout_us"] == pytest.approx(40_000)
    assert found["rollout_ratio"] == pytest.approx(0.5)  # of 0.5, 0.4 and 1.5
    assert found["act_us"] == pytest.approx(30_000)
    assert found["act_ratio"] == pytest.approx(1.5)  # of 0.5, 1.5 and 2.5
    assert found["core_share"] == pytest.approx(0.8)  # of 1, 0.5 and 0.8


@pytest.mark.parametrize(
    ("contender", "ratio", "highest", "flag"),
    [
        ("ours", 0.9, 0.99, "  SLOWER"),
        ("plug-in", 0.9, 0.99, "  SLOWER"),
        ("ours, rigl", 0.9, 1.1, "  slower in the median"),
        ("ours", 1.0, 1.1, ""),
        ("sbx", 0.9, 0.99, ""),
    ],
)
def test_ours_is_flagged_where_it_is_slower_than_stock(end_to_end, contender, ratio, highest, flag):
    second = dict(steps=10, seconds=1.0, elapsed=1.0, train=0.5, act=0.1)
    who = dict(case="sac-256", env="HalfCheetah-v5", activation="", sparsity=0.9)
    row = {**who, "contender": contender, **end_to_end.summary([second], [second])}
    line = end_to_end.line({**row, "ratio": ratio, "ratio_highest": highest})
    assert line.partition("action 10000 us (1.00)")[2] == flag


def test_a_busy_core_is_said(end_to_end):
    second = dict(steps=10, seconds=1.0, elapsed=2.0, train=0.5, act=0.1)
    who = dict(case="a2c-64", env="CartPole-v1", activation="", sparsity="", contender="stock")
    line = end_to_end.line({**who, **end_to_end.summary([second], [second])})
    assert "10.0 steps/s" in line
    assert line.endswith("  had 50% of the core")


def test_a_case_names_algorithm_network_and_environment(end_to_end):
    assert end_to_end.parsed("dqn4-64") == ("dqn4", "64", "CartPole-v1")
    assert end_to_end.parsed("ppo-64@CartPole-v1") == ("ppo", "64", "CartPole-v1")
    assert end_to_end.parsed("ppo-impala") == ("ppo", "impala", "noise")
    pong = "PongNoFrameskip-v4"
    assert end_to_end.parsed(f"dqn4-nature@{pong}") == ("dqn4", "nature", pong)


def test_an_atari_game_is_seen_as_four_grey_frames(end_to_end):
    pytest.importorskip("ale_py")
    import learner

    game = learner.environment("PongNoFrameskip-v4")
    assert game.reset().shape == (1, 84, 84, 4)
    assert game.env_is_wrapped(AtariWrapper) == [True]
    game.close()


def test_atari_without_its_emulator_is_rejected_with_a_recipe(end_to_end, monkeypatch):
    import learner

    monkeypatch.setitem(sys.modules, "ale_py", None)
    with pytest.raises(SystemExit, match="needs ale_py: pip install ale-py opencv-python"):
        learner.environment("PongNoFrameskip-v4")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--cases", "sack-256"], "the algorithm is one of sac, td3"),
        (["--cases", "sac-wide"], "the network is a width, such as 256, or one of impala, nature"),
        (["--cases", "sac-nature"], "image networks go with DQN"),
        (["--cases", "dqn-nature@CartPole-v1"], "or of an Atari game, such as PongNoFrameskip-v4"),
        (["--sparsity", "0.9,1"], "from 0 to below 1, got 1.0"),
        (["--sparsity", "most"], "separated by commas, got 'most'"),
        (["--activation", "relu,gelu"], "one of relu, tanh, elu, silu; got gelu"),
        (["--rounds", "0"], "--rounds is 1 or more"),
        (["--table", "no.csv"], "there is no file no.csv"),
        (["--sbx", "/nowhere/python"], "cannot be run"),
    ],
)
def test_what_cannot_be_measured_is_rejected_at_once(
    end_to_end, monkeypatch, capsys, tmp_path, words, message
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["end_to_end.py", *words])
    with pytest.raises(SystemExit) as left:
        end_to_end.main()
    assert left.value.code == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_python_without_sbx_is_rejected_with_a_recipe(end_to_end, monkeypatch, capsys, tmp_path):
    bare = tmp_path / "python"
    bare.write_text(f'#!/bin/sh\nexec "{sys.executable}" -I -S "$@"\n')  # no site-packages
    bare.chmod(0o755)
    monkeypatch.setattr(sys, "argv", ["end_to_end.py", "--sbx", str(bare)])
    with pytest.raises(SystemExit) as left:
        end_to_end.main()
    assert left.value.code == 2
    message = capsys.readouterr().err
    assert "is no Python with SBX (ModuleNotFoundError: No module named 'sbx')" in message
    assert 'sbx/bin/pip install sbx-rl "gymnasium[mujoco]"' in message


def test_a_worker_that_dies_ends_the_benchmark_with_its_reason(end_to_end, capfd):
    worker = end_to_end.Worker(sys.executable)
    spec = dict(kind="stock", algo="ppo", net="8", env="NoSuchEnv-v0", activation=None, rollout=64)
    with pytest.raises(SystemExit, match="a worker ended with code 1"):
        worker.ask(make={"stock": spec})
    assert "NoSuchEnv" in capfd.readouterr().err
