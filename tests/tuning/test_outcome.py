"""What a study leaves behind: best values that train as they are, a page, a CSV, progress."""

from __future__ import annotations

import io
import re
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import pytest
import yaml
from rich.console import Console
from tuning_support import Here, choices, searched, small_run

from sb3_sparse.cli.progress.tune import TuningProgress
from sb3_sparse.errors import ConfigError
from sb3_sparse.tuning import tune
from sb3_sparse.tuning.backend import TrialState, optuna
from sb3_sparse.tuning.best import check_target, merge_best, write_best
from sb3_sparse.tuning.report import report_by_name
from sb3_sparse.tuning.samplers import TICKET
from sb3_sparse.tuning.search import Search
from sb3_sparse.tuning.storage import open_storage
from sb3_sparse.tuning.tuner import define
from sb3_sparse.zoo.configs import config_path
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.training import train

LOGS = Path("logs")
SPACE = choices(weight_decay=[0.0, 1e-6, 1e-4], update_interval=[100, 200])


def finished(storage, name, value, run=None, space=SPACE):
    """A study whose trials were not trained: each has the value that a function gives it."""
    return searched(storage, name, lambda values, _: [value(values)] * 6, run or small_run(), space)


def decay_matters(values) -> float:
    return 100 - abs(values["weight_decay"] - 1e-6) * 1e5 - values["update_interval"] / 100


@pytest.fixture
def storage(tmp_path):
    return open_storage(tmp_path / "tune" / "journal.log")


@pytest.fixture
def study(storage):
    return finished(storage, "mine", decay_matters)


def test_the_best_values_are_a_config_that_trains_as_it_is(study, tmp_path):
    path = write_best(Search(study), tmp_path / "best.yml")
    first = path.read_text().splitlines()[0]
    assert re.fullmatch(
        r"# Tuned by sb3-sparse: search mine, trial \d of 6 trials, score 99, \d{4}-\d\d-\d\d",
        first,
    )
    datetime.strptime(first.rpartition(" ")[2], "%Y-%m-%d")
    content = yaml.safe_load(path.read_text())
    assert content.keys() == {"CartPole-v1"}
    entry = content["CartPole-v1"]
    assert entry == Search(study).best_entry()[0]
    assert entry["policy_kwargs"]["weight_decay"] == 1e-6
    assert "compute" not in entry["policy_kwargs"]  # a choice of tuning's
    assert entry["callback"][0]["sb3_sparse.SparsityCallback"]["update_interval"] == 100
    outcome = train(RunSpec(conf_file=str(path), eval_freq=300, eval_episodes=1), tmp_path)
    assert outcome.finished
    assert outcome.model.policy.optimizer.param_groups[0]["lr"] == 1e-3
    assert outcome.model.num_timesteps == 600
    zoo = [sys.executable, "-m", "rl_zoo3.train", "--algo", "dqn", "--env", "CartPole-v1"]
    subprocess.run([*zoo, "--conf-file", str(path), "-f", "zoo"], cwd=tmp_path, check=True)


def test_the_best_values_go_into_one_entry_of_a_config(storage, tmp_path):
    study = finished(storage, "acrobot", decay_matters, small_run(env_id="Acrobot-v1"))
    path = tmp_path / "dqn.yml"
    text = config_path("rigl", "dqn").read_text()
    path.write_text(text)
    merge_best(Search(study), path)
    before, after = yaml.safe_load(text), yaml.safe_load(path.read_text())
    assert after["Acrobot-v1"] == Search(study).best_entry()[0]
    assert {**after, "Acrobot-v1": None} == {**before, "Acrobot-v1": None}
    lines = iter(path.read_text().splitlines())
    assert all(line in lines for line in text.splitlines())  # all are there, in their order
    assert "Acrobot-v1:\n  # Tuned by sb3-sparse: search acrobot, " in path.read_text()


def config_of_ones_own(tmp_path) -> Path:
    path = tmp_path / "mine.yml"
    path.write_text(config_path("rigl", "dqn").read_text())
    return path


def test_a_study_whose_config_has_taken_the_best_values_is_still_the_same(storage, tmp_path):
    path = config_of_ones_own(tmp_path)
    run = small_run(env_id="Acrobot-v1", conf_file=str(path))
    study = finished(storage, "mine", decay_matters, run)
    best = Search(study).best_entry()[0]
    merge_best(Search(study), path)
    again = finished(storage, "mine", decay_matters, run)
    assert len(again.get_trials()) == 6
    assert Search(again).best_entry()[0] == best
    path.write_text(path.read_text().replace("gamma: 0.99", "gamma: 0.9"))
    with pytest.raises(ConfigError, match="settings.gamma is 0.99 there and 0.9 now"):
        finished(storage, "mine", decay_matters, run)


def test_a_study_needs_its_config_no_more(storage, study, tmp_path):
    path = config_of_ones_own(tmp_path)
    other = finished(storage, "other", decay_matters, small_run(conf_file=str(path)))
    path.unlink()
    assert "<h1>Tuning: mine</h1>" in report_by_name(["mine"], None, tmp_path, None).read_text()
    assert Search(other).best_entry()[0]["gamma"] == 0.99


def test_a_link_stays_a_link_and_modes_stay(storage, tmp_path):
    path = config_of_ones_own(tmp_path)
    path.chmod(0o664)
    link = tmp_path / "link.yml"
    link.symlink_to(path)
    study = finished(storage, "a", decay_matters, small_run(env_id="Acrobot-v1"))
    merge_best(Search(study), link)
    assert link.is_symlink()
    assert "Tuned by" in path.read_text()
    assert path.stat().st_mode & 0o777 == 0o664


def test_what_cannot_take_the_values_is_refused_before_the_search(tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text(
        "CartPole-v1: {n_timesteps: 9, policy: sb3_sparse.SparsePolicy, policy_kwargs: "
        "{sparsity: 0.9}, callback: [{sb3_sparse.SparsityCallback: {method: rigl}}]}\n"
    )
    with pytest.raises(ConfigError, match="it is not a block of its own; take the tuned settings"):
        check_target(small_run(), path)


def test_a_config_of_another_method_is_left_alone(study, tmp_path):
    path = tmp_path / "dqn.yml"
    path.write_text(config_path("set", "dqn").read_text())
    with pytest.raises(ConfigError, match="by method 'set', but 'rigl' is tuned"):
        merge_best(Search(study), path)
    assert path.read_text() == config_path("set", "dqn").read_text()


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (
            ["nope"],
            "there is no search 'nope' in .*journal.log; its searches are foreign, mine, new",
        ),
        (["foreign"], "'foreign' in .* was not made by sb3-sparse tune; look at it with optuna-d"),
        (["new"], "no trial of 'new' was completed yet, so there is nothing to report"),
    ],
)
def test_studies_that_cannot_be_reported(study, storage, tmp_path, names, message):
    optuna.create_study(storage=storage, study_name="foreign")
    Search.enter(storage, "new", define(small_run(), SPACE, 1, None, None, LOGS), 6)
    with pytest.raises(ConfigError, match=message):
        report_by_name(names, None, tmp_path, None)


def test_a_journal_that_is_not_there(tmp_path):
    with pytest.raises(ConfigError, match="there are no searches in .*journal.log; give the"):
        report_by_name(["x"], None, tmp_path, None)


def test_no_best_without_a_trial(storage, tmp_path):
    new = Search.enter(storage, "new", define(small_run(), SPACE, 1, None, None, LOGS), 6)
    with pytest.raises(ConfigError, match="no trial of 'new' was completed yet"):
        write_best(new, tmp_path / "best.yml")
    assert not (tmp_path / "best.yml").exists()


def test_progress_is_a_line_a_trial_with_the_best_so_far(storage):
    text = io.StringIO()
    progress = TuningProgress(Console(file=text, width=200))
    search = Search.enter(storage, "new", define(small_run(), SPACE, 1, None, None, LOGS), 6)
    study = search.study
    progress(search.status())
    for value in (3.0, 1.0):
        study.optimize(lambda trial, value=value: value, n_trials=1)
        progress(search.status())
    with pytest.raises(ZeroDivisionError):
        study.optimize(lambda trial: 1 / 0, n_trials=1)
    progress(search.status())
    progress(search.status())
    progress.close()
    assert [line.rstrip(" ;") for line in text.getvalue().splitlines()] == [
        "1 of 6: trial 0 score 3, best so far 3 (trial 0)",
        "2 of 6: trial 1 score 1, best so far 3 (trial 0)",
        "trial 2 failed: no reason known",
    ]


def test_the_last_attempt_at_a_planned_trial_counts(storage):
    search = Search.enter(storage, "new", define(small_run(), SPACE, 1, None, None, LOGS), 1)
    study = search.study
    with pytest.raises(ZeroDivisionError):
        study.optimize(lambda trial: 1 / 0, n_trials=1)
    assert len(search.status().failed) == 1
    waiting = optuna.create_trial(state=TrialState.WAITING, system_attrs={TICKET: 0})
    study.add_trial(waiting)
    assert not search.status().failed
    study.optimize(lambda trial: 5.0, n_trials=1)
    status = search.status()
    assert status.finished
    assert status.best.number == 1


def test_tune_is_one_call(tmp_path):
    run, space = small_run(n_timesteps=200), choices(weight_decay=[0.0])
    tuned = tune(run, space, log_folder=tmp_path, launcher=Here())
    assert tuned.best.params == {"weight_decay": 0.0}
    assert tuned.config == tmp_path / "tune" / "dqn_CartPole-v1_rigl_0.9_small" / "best.yml"
    assert tuned.errors == {}
