"""The command line as a user types it."""

from __future__ import annotations

import re
import shlex
import signal
import subprocess
import sys
import time
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
from forks import run_in_forks
from stable_baselines3 import DQN, PPO
from support import make

from sb3_sparse.cli import main

QUICK = ["--hyperparams", "net_arch:[24,24]", "batch_size:16"]


def test_train_says_what_it_does_and_enjoy_and_inspect_read_it(tmp_path, sb3_sparse):
    evaluation = ["--eval-freq", "500", "--eval-episodes", "2"]
    run = ["--env", "CartPole-v1", "-n", "1500", "--seed", "3"]
    code, said, errors = sb3_sparse("train", *run, *evaluation, *QUICK)
    assert code == 0, errors
    assert "Training DQN on CartPole-v1, rigl at 90% (ERK), seed 3" in said
    assert "\nGradient steps: fused\n" in said
    progress = r"1500 of 1500 steps, training return \d+\.\d, sparsity 8\d\.\d\d%, \d+ steps/s"
    assert re.search(progress, said)
    for step in (500, 1000, 1500):  # each evaluation is a line, also without a terminal
        line = rf"^evaluated at step {step}: return \d+\.\d ± \d+\.\d, best so far \d+\.\d$"
        assert re.search(line, said, re.MULTILINE)
    assert "Evaluating the last policy, episodes: 2" in said
    assert "Return over 2 episodes:" in said
    folder = Path("logs") / "dqn" / "CartPole-v1_1"
    for what, name in (("Last policy", "CartPole-v1.zip"), ("Best policy", "best_model.zip")):
        score = r":\s+\d+\.\d ± \d+\.\d  "
        assert re.search(what + score + re.escape(str(folder / name)), said)
    path = tmp_path / folder / "CartPole-v1.zip"
    assert DQN.load(path).num_timesteps == 1500

    code, said, errors = sb3_sparse("enjoy", str(folder), "-n", "2", "--best")
    assert code == 0, errors
    assert re.search(r"Best policy:\s+\d+\.\d ± \d+\.\d  .*best_model.zip", said)

    code, said, errors = sb3_sparse("inspect", str(path.with_suffix("")))
    assert code == 0, errors
    # 4-24-24-2 has 96 + 576 + 48 connections; with floors, 72 or one or two more remain
    nnz, density = re.search(r"total\s+(\d+)\s+(0\.\d+)", said).groups()
    assert 72 <= int(nnz) <= 75
    assert float(density) == round(int(nnz) / 720, 4)
    assert "The run asked for compute='auto'." in said
    assert "Trained from step 0: 0 of 3 layers in sparse storage" in said


@pytest.mark.parametrize("compute", ["auto", "sparse"])
def test_inspect_says_how_large_layers_compute(tmp_path, compute, sb3_sparse):
    kwargs = dict(sparsity=0.99, net_arch=[300, 300], compute=compute)
    make("SAC", policy_kwargs=kwargs, batch_size=128).save(tmp_path / "model")
    code, said, errors = sb3_sparse("inspect", "model.zip")
    assert code == 0, errors
    sparse = re.findall(r"^(\S+) .* sparse$", said, re.MULTILINE)
    critics = [f"critic.qf{i}.{j}" for i in (0, 1) for j in (0, 2, 4)]
    heads = ["actor.mu", "actor.log_std"] if compute == "sparse" else []
    assert sparse == ["actor.latent_pi.0", "actor.latent_pi.2", *heads, *critics]
    chosen = "compute='auto': 8 of 10 layers in sparse storage here"
    assert (chosen in said) == (compute == "auto")
    assert ("was made with compute='sparse'" in said) == (compute == "sparse")


def test_inspect_of_a_damaged_file_and_of_a_model_without_minibatches(tmp_path, sb3_sparse):
    make("A2C", n_steps=6).save(tmp_path / "model")
    _, said, errors = sb3_sparse("inspect", "model.zip")
    assert "compute='auto' keeps masks" in said, errors
    with zipfile.ZipFile(tmp_path / "half.zip", "w") as half:
        half.writestr("_stable_baselines3_version", "2.9.2")
    code, _, errors = sb3_sparse("inspect", "half.zip")
    assert code == 2
    assert "half.zip is damaged" in errors


def test_a_killed_run_goes_on_from_its_last_evaluation(tmp_path, sb3_sparse):
    folder = tmp_path / "logs" / "dqn" / "CartPole-v1_1"
    args = ["--algo", "dqn", "-n", "3000", "--eval-freq", "300", "--eval-episodes", "1", *QUICK]
    code = "from sb3_sparse.cli import main; main()"
    running = subprocess.Popen([sys.executable, "-c", code, "train", *args], cwd=tmp_path)
    while not list(folder.glob("resume/[0-9]*")):
        assert running.poll() is None, "it ended before its first checkpoint"
        time.sleep(0.05)
    running.kill()
    running.wait()
    assert not (folder / "CartPole-v1.zip").exists()
    code, _, errors = sb3_sparse("train", "--resume", str(folder))
    assert code == 0, errors
    with np.load(folder / "evaluations.npz") as evaluations:
        assert evaluations["timesteps"].tolist() == list(range(300, 3001, 300))
    assert DQN.load(folder / "CartPole-v1.zip").num_timesteps == 3000


def test_a_run_that_is_asked_to_stop_says_how_to_go_on(tmp_path):
    folder = tmp_path / "logs" / "dqn" / "CartPole-v1_1"
    args = ["--algo", "dqn", "-n", "100000", "--eval-freq", "300", "--eval-episodes", "1", *QUICK]
    code = "from sb3_sparse.cli import main; main()"
    command = [sys.executable, "-c", code, "train", *args]
    running = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    while not list(folder.glob("resume/[0-9]*")):
        assert running.poll() is None, "it ended before its first checkpoint"
        time.sleep(0.05)
    running.send_signal(signal.SIGINT)
    said, _ = running.communicate(timeout=60)
    assert running.returncode == 130
    steps = DQN.load(folder / "CartPole-v1.zip").num_timesteps
    assert f"Stopped after {steps} steps. Resume with:" in said
    assert "sb3-sparse train --resume logs/dqn/CartPole-v1_1" in said


@pytest.mark.parametrize("folder", [None, Path("my logs/dqn/CartPole-v1_3")])
def test_an_interrupt_says_how_to_go_on_with_this_run(folder, monkeypatch, capsys):
    def interrupted(run, log_folder, *, tensorboard_log, watch):
        if folder is not None:
            watch.begins(folder, None)
        raise KeyboardInterrupt

    monkeypatch.setattr("sb3_sparse.zoo.training.train", interrupted)
    monkeypatch.setattr(sys, "argv", ["sb3-sparse", "train"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130
    last = capsys.readouterr().out.splitlines()[-1]
    if folder is None:
        assert last == "Interrupted before the run began; no files were left behind."
    else:
        assert last == "sb3-sparse train --resume 'my logs/dqn/CartPole-v1_3'"


def test_options_and_a_second_run_beside_the_first(tmp_path, sb3_sparse):
    args = ["--algo", "ppo", "--env", "CartPole-v1", "--method", "prune", "--sparsity", "0.8"]
    args += ["--distribution", "uniform", "-n", "300", "--log-folder", "else where"]
    args += ["--n-envs", "2", "--eval-episodes", "2"]
    for number in (1, 2):
        code, said, errors = sb3_sparse("train", *args)
        assert code == 0, errors
        path = tmp_path / "else where" / "ppo" / f"CartPole-v1_{number}" / "CartPole-v1.zip"
        model = PPO.load(path)
        folder = f"else where/ppo/CartPole-v1_{number}"
        enjoy, export, study = map(shlex.split, said.splitlines()[-3:])
        assert enjoy == ["sb3-sparse", "enjoy", folder]
        assert export == ["sb3-sparse", "export", folder, "--to", "c", "policy.c"]
        assert study == ["sb3-sparse", "study", "list"]
    assert model.n_envs == 2
    for layer in model.policy.sparse.layers:
        assert layer.nnz == layer.size - int(0.8 * layer.size + 1e-6)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (
            ["--algo", "dqnn"],
            "unknown algorithm 'dqnn' (did you mean 'dqn'?); allowed are dqn",
        ),
        (
            ["--env", "CartPool-v1"],
            "'CartPool-v1' (did you mean 'CartPole-v1'?)",
        ),
        (["--method", "riggle"], "no config is shipped for method 'riggle', only for dense, "),
        (["--sparsity", "1.5"], "must lie in [0, 1)"),
        (["--distribution", "flat"], "allowed are er, erk, uniform"),
        (["-n", "0"], "must be 1 or more, got 0"),
        (["--algo", "sac", "--env", "CartPole-v1"], "sac cannot act in CartPole-v1"),
        (["--algo", "dqn", "--env", "Pendulum-v1"], "dqn cannot act in Pendulum-v1"),
        (["--hyperparams", "gama:0.9"], "did you mean 'gamma'?"),
        (["--hyperparams", "gamma"], "given as name:value"),
        (["gamma:0.9"], "unexpected argument 'gamma:0.9'"),
        (
            ["--hyperparams", "learning_rate:fast"],
            "learning_rate must be a number, 0 or more, ",
        ),
        (["--hyperparams", "optimizer_kwargs:{'epz':1}"], "do not work: TypeError"),
        (["--resume", "nowhere"], "no run of sb3-sparse in nowhere"),
        (["--resume", "nowhere", "--seed", "3"], "--resume takes all settings from the run; drop"),
        (["--conf-file", "mine.yml"], "there is no config file mine.yml"),
    ],
)
def test_mistakes_are_one_line_and_make_nothing(args, message, tmp_path, mistake):
    assert message in mistake("train", *args)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_enjoy_of_what_is_no_run(mistake):
    assert "there is no run and no model nowhere; give a run's folder" in mistake(
        "enjoy", "nowhere"
    )


LACKS = """
missing = {!r}
loaded = [name for name in sys.modules if name.partition(".")[0] == missing]
sys.modules.update(dict.fromkeys([missing, *loaded]))
"""
TRAIN = "sys.argv[1:] = {!r}\nfrom sb3_sparse.cli import main; main()"
RUNS = {
    "rl_zoo3": ([], "sb3-sparse[zoo]"),
    "rich": ([], "sb3-sparse[zoo]"),
    "yaml": ([], "sb3-sparse[zoo]"),
    "ale_py": (["--env", "PongNoFrameskip-v4"], "PongNoFrameskip-v4 needs sb3-sparse[atari]"),
    "cv2": (["--env", "PongNoFrameskip-v4"], "PongNoFrameskip-v4 needs sb3-sparse[atari]"),
    "shimmy": (["--env", "dm_control/dog-run-v0"], "dm_control/dog-run-v0 needs sb3-sparse[dmc]"),
    "dm_control": (
        ["--env", "dm_control/dog-run-v0"],
        "dm_control/dog-run-v0 needs sb3-sparse[dmc]",
    ),
    "mujoco": (["--algo", "sac", "--env", "Ant-v5"], "Ant-v5 needs sb3-sparse[mujoco]"),
    "tensorboard": (["-tb", "tb"], "pip install tensorboard"),
}
IMPORTS = {
    "typer": ("import sb3_sparse.cli", "sb3-sparse[zoo]"),
    "sb3_contrib": (
        "import sb3_sparse; sb3_sparse.TQC",
        "or TRPO needs sb3-sparse[contrib]",
    ),
}


@pytest.fixture(scope="module")
def without(tmp_path_factory):
    """What each command or import ends with that lacks a package."""
    asked = {name: TRAIN.format(["train", *args]) for name, (args, _) in RUNS.items()}
    asked |= {name: code for name, (code, _) in IMPORTS.items()}
    codes = [LACKS.format(name) + code for name, code in asked.items()]
    forks = run_in_forks("import stable_baselines3", codes, tmp_path_factory.mktemp("without"))
    return dict(zip(asked, forks, strict=True))


@pytest.mark.parametrize("missing", RUNS)
def test_a_missing_extra_of_a_run_names_its_cure_in_one_line(missing, without):
    done = without[missing]
    assert done.code != 0
    assert RUNS[missing][1] in done.err
    assert "Traceback" not in done.err
    assert not [path for path in done.folder.rglob("*") if path.is_file()]


@pytest.mark.parametrize("missing", IMPORTS)
def test_a_missing_extra_names_its_cure(missing, without):
    assert without[missing].code != 0
    assert IMPORTS[missing][1] in without[missing].err


def test_inspect_of_what_is_no_model(tmp_path, mistake):
    (tmp_path / "notes.zip").write_text("no zip at all")
    for name, message in (
        ("gone.zip", "there is no file"),
        ("notes.zip", "is damaged, or holds no model saved by SB3"),
    ):
        assert message in mistake("inspect", name)


def test_the_core_works_without_any_extra(tmp_path):
    missing = ["sb3_contrib", "typer", "rich", "tqdm", "rl_zoo3", "optuna", "mujoco", "pandas"]
    script = (
        f"import sys; [sys.modules.__setitem__(name, None) for name in {missing}]\n"
        "import sb3_sparse\n"
        "from stable_baselines3 import PPO\n"
        "model = PPO('SparsePolicy', 'CartPole-v1', n_steps=16, batch_size=16,"
        " policy_kwargs=dict(sparsity=0.9))\n"
        "model.learn(16, callback=sb3_sparse.SparsityCallback('rigl'))\n"
        "assert 'TQC' not in sb3_sparse.supported_algorithms()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_our_warnings_are_one_line_without_code_and_others_are_as_they_were(capsys):
    from sb3_sparse.cli import _show_ours_alone
    from sb3_sparse.errors import SparsityWarning

    others: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = lambda message, *_: others.append(str(message))
        _show_ours_alone()
        warnings.warn("update_interval is [odd]", SparsityWarning, stacklevel=1)
        warnings.warn("theirs", UserWarning, stacklevel=1)
    assert capsys.readouterr().err == "Warning: update_interval is [odd]\n"
    assert others == ["theirs"]
