"""``sb3-sparse tune``, as a user types it."""

from __future__ import annotations

import re

import pytest
import yaml

QUICK = ["-n", "200", "--eval-freq", "100", "--eval-episodes", "1", "--method", "rigl"]
SMALL = ["-params", "net_arch:[16]", "learning_starts:50"]
STUDY = "dqn_CartPole-v1_rigl_0.9_mine"


def test_tune_searches_writes_the_best_goes_on_and_reports(tmp_path, sb3_sparse):
    (tmp_path / "mine.yml").write_text("weight_decay: [0.0, 1.0e-4]\n")
    target = tmp_path / "dqn.yml"
    target.write_text(
        "# mine\nCartPole-v1:\n  n_timesteps: 9\n  policy: sb3_sparse.SparsePolicy\n"
        "  policy_kwargs: {sparsity: 0.9}\n"
        "  callback: [{sb3_sparse.SparsityCallback: {method: rigl}}]\nOther-v0: {a: 1}  # stays\n"
    )
    args = ["tune", *QUICK, "--space", "mine.yml", *SMALL]
    code, said, errors = sb3_sparse(*args, "--write-into", "dqn.yml")
    assert code == 0, errors + said
    lines = said.splitlines()
    assert re.fullmatch(
        r"2 of 2: trial 1 score \S+, best so far \S+ \(trial [01]\); weight_decay (0|0.0001)",
        lines[1],
    )
    assert f"Search {STUDY}: 2 of 2 trials are done." in lines
    best = tmp_path / "logs" / "tune" / STUDY / "best.yml"
    given = best.relative_to(tmp_path)  # as --log-folder is
    command = f"sb3-sparse train --algo dqn --env CartPole-v1 --conf-file {given}"
    assert command in lines
    assert f"sb3-sparse tune report {STUDY}" in lines
    merged = yaml.safe_load(target.read_text())
    assert merged["CartPole-v1"] == yaml.safe_load(best.read_text())["CartPole-v1"]
    assert target.read_text().startswith("# mine\nCartPole-v1:\n  # Tuned by sb3-sparse: search ")
    assert target.read_text().endswith("Other-v0: {a: 1}  # stays\n")

    _, said, _ = sb3_sparse(*args)
    assert said.startswith(f"The search {STUDY} is finished: 2 of 2 trials are done. Nothing")

    code, _, errors = sb3_sparse("tune", "report", STUDY)
    assert code == 0, errors
    page = tmp_path / "logs" / "tune" / STUDY / "report.html"
    assert "the best of 2 trials scores" in page.read_text()
    assert page.with_suffix(".csv").read_text().count("\n") == 3

    code, _, errors = sb3_sparse(*command.split()[1:], "--eval-freq", "100")
    assert code == 0, errors


def test_trials_that_fail_are_shown_and_the_exit_code_says_so(tmp_path, sb3_sparse):
    (tmp_path / "mine.yml").write_text("env_wrapper: [null, no.such.Wrapper]\n")
    code, said, _ = sb3_sparse("tune", *QUICK, "--space", "mine.yml", *SMALL)
    assert code == 1
    assert re.search(r"trial \d failed: ConfigError: .*No module named 'no'", said)
    assert "1 of 2 trials are done, 1 failed; the logs of the workers are in" in said
    assert "Best: " in said


DATABASE = "postgresql://me:s3cret@127.0.0.1:9/x"


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--space", "nope"], "unknown search space 'nope'; allowed are paper, wide, or a file"),
        (["--method", "dense", "--space", "bad.yml"], "'dense' has no update_interval"),
        (["--space", "odd.yml"], "DQN has no hyperparameter 'colour'"),
        (["--space", "empty.yml"], "the search space 'empty' is empty"),
        (["--storage", DATABASE], "me:***@127.0.0.1:9/x cannot be reached"),
        (["--launcher", "slurm"], "unknown launcher 'slurm'; allowed are local, ray"),
        (["--address", "auto"], "add --launcher ray"),
        (["--workers", "0"], "workers must be 1 or more, got 0"),
        (["--sampler", "cma"], "unknown sampler 'cma'"),
        (["--seeds", "0"], "seeds must lie in [1, 1000], got 0"),
        (["--trials", "999"], "at most 200, the cells of the grid; got 999"),
        (["--write-into", "none.yml"], "there is no config file none.yml"),
        (
            ["-n", "600", "--eval-freq", "601"],
            "a run of 600 steps that is evaluated every 601 has no score",
        ),
        (["report", "x"], "there are no searches in logs/tune/journal.log"),
    ],
)
def test_mistakes_are_one_line_and_make_nothing(args, message, tmp_path, mistake):
    (tmp_path / "bad.yml").write_text("update_interval: [100]\n")
    (tmp_path / "odd.yml").write_text("colour: [red]\n")
    (tmp_path / "empty.yml").write_text("{}\n")
    line = mistake("tune", *args)
    assert message in line
    assert "s3cret" not in line
    assert not (tmp_path / "logs").exists()


def test_help_has_a_line_on_every_command(capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["sb3-sparse", "--help"])
    monkeypatch.setenv("COLUMNS", "200")
    from sb3_sparse.cli import main

    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    said = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    for name in ("train", "enjoy", "inspect", "compress", "export", "tune", "study"):
        assert re.search(rf"^[^\w\n]*{name} +[A-Z]\w+", said, re.MULTILINE), name
