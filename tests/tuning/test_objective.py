"""What a trial does, and that it does the same again."""

from __future__ import annotations

import json
from pathlib import Path
from statistics import fmean

import numpy as np
import pytest
from forks import run_in_forks
from stable_baselines3 import DQN
from tuning_support import Here, choices, small_run

from sb3_sparse.errors import ConfigError
from sb3_sparse.tuning import Objective, Space, tune
from sb3_sparse.tuning.backend import TrialState, optuna
from sb3_sparse.tuning.samplers import SeededByTrial, pruner_of, sampler_of
from sb3_sparse.zoo.results import score_of

FLOAT = optuna.distributions.FloatDistribution
SPACE = Space("small", {"learning_rate": FLOAT(1e-4, 1e-2, log=True), "drop_fraction": FLOAT(0, 1)})


def evaluations(folder: Path) -> list[list[float]]:
    """Mean returns of each run below a folder, in the order of the runs."""
    runs = sorted(folder.rglob("evaluations.npz"))
    return [np.load(path)["results"].mean(axis=1).tolist() for path in runs]


@pytest.mark.parametrize(
    ("returns", "score"),
    [
        ([5.0], 5.0),
        ([1.0, 3.0], 3.0),
        (list(range(10)), 9.0),
        (list(range(11)), 9.5),  # 1.1 evaluations are 2
        (list(range(20)), 18.5),
        (list(range(50)), 47.0),
    ],
)
def test_a_score_is_the_mean_of_the_last_tenth(returns, score):
    assert score_of(returns) == score


def test_a_trial_is_the_mean_score_of_its_seeds(tmp_path):
    study = optuna.create_study(direction="maximize")
    run = small_run(n_timesteps=240, eval_freq=20, seed=5)
    study.optimize(Objective(run, choices(weight_decay=[1e-4]), 2, tmp_path), n_trials=1)
    (trial,) = study.trials
    first, second = evaluations(tmp_path / "0")
    assert len(first) == len(second) == 12
    scores = [fmean(first[-2:]), fmean(second[-2:])]
    assert trial.user_attrs["scores"] == pytest.approx(scores)
    assert trial.value == pytest.approx(fmean(scores))
    reported = [*first, *(fmean([scores[0], later]) for later in second)]
    assert trial.intermediate_values == pytest.approx(dict(enumerate(reported, 1)))
    assert trial.user_attrs["hyperparams"] == {"weight_decay": 1e-4}
    seeds = set()
    for path in sorted(tmp_path.rglob("sparsity.json")):
        record = json.loads(path.read_text())
        seeds.add(record["run"]["seed"])
        assert record["settings"]["policy_kwargs"]["weight_decay"] == 1e-4
        assert record["status"] == "finished"
    assert seeds == {5, 6}


def test_a_pruned_trial_stops_and_says_so(tmp_path):
    class AfterThree(optuna.pruners.BasePruner):
        def prune(self, study, trial):
            return trial.last_step == 3

    study = optuna.create_study(direction="maximize", pruner=AfterThree())
    study.optimize(Objective(small_run(), choices(weight_decay=[0.0]), 2, tmp_path), n_trials=1)
    (trial,) = study.trials
    assert trial.state == TrialState.PRUNED
    assert list(trial.intermediate_values) == [1, 2, 3]
    (record,) = tmp_path.rglob("sparsity.json")
    content = json.loads(record.read_text())
    assert (content["status"], content["error"]) == ("pruned", None)
    assert not (record.parent / "resume").exists()


def test_a_trial_that_diverges_is_pruned_says_so_and_the_study_goes_on(tmp_path):
    study = optuna.create_study(
        sampler=optuna.samplers.GridSampler({"learning_rate": [1e35, 1e-3]})
    )
    space = choices(learning_rate=[1e35, 1e-3])
    study.optimize(Objective(small_run(), space, 1, tmp_path), n_trials=2)
    ended = {trial.params["learning_rate"]: trial for trial in study.trials}
    assert ended[1e-3].state == TrialState.COMPLETE
    assert ended[1e35].state == TrialState.PRUNED
    assert "training diverged: at step" in ended[1e35].user_attrs["diverged"]
    (folder,) = (tmp_path / str(ended[1e35].number)).rglob("sparsity.json")
    assert json.loads(folder.read_text())["status"] == "diverged"


def test_a_whole_trial_is_never_pruned_at_its_end(tmp_path):
    class AtTheEnd(optuna.pruners.BasePruner):
        def prune(self, study, trial):
            return trial.last_step == 6

    study = optuna.create_study(direction="maximize", pruner=AtTheEnd())
    study.optimize(Objective(small_run(), choices(weight_decay=[0.0]), 1, tmp_path), n_trials=1)
    assert study.trials[0].state == TrialState.COMPLETE


def test_rollouts_that_pass_the_end_report_no_more_than_planned(tmp_path):
    run = small_run(
        algo="ppo", n_timesteps=300, hyperparams={"n_steps": 128, "n_envs": 2, "net_arch": [8]}
    )
    study = optuna.create_study(direction="maximize")
    study.optimize(Objective(run, choices(weight_decay=[0.0]), 2, tmp_path), n_trials=1)
    (trial,) = study.trials
    assert list(trial.intermediate_values) == [1, 2, 3, 4, 5, 6]
    first, second = evaluations(tmp_path / "0")
    assert len(first) == len(second) == 5
    assert trial.value == pytest.approx(fmean([first[-1], second[-1]]))


@pytest.mark.parametrize("sampler", ["tpe", "grid"])
def test_one_worker_with_the_same_seed_makes_the_same_trials(tmp_path, sampler):
    space = SPACE if sampler != "grid" else choices(weight_decay=[0.0, 1e-4, 1e-3])

    def trials(folder, name):
        tuned = tune(
            small_run(seed=3, n_timesteps=300),
            space,
            trials=3,
            sampler=sampler,
            log_folder=tmp_path / folder,
            name=name,
            launcher=Here(),
        )
        return [(t.params, t.values, t.intermediate_values) for t in tuned.study.trials]

    once = trials("once", "a")
    assert once == trials("again", "b")
    assert len({str(params) for params, *_ in once}) == 3


def test_a_model_of_a_trial_is_the_same_bit_for_bit(tmp_path):
    study = optuna.create_study(direction="maximize")
    objective = Objective(small_run(), SPACE, 1, tmp_path)
    for _ in range(2):
        study.enqueue_trial({"learning_rate": 1e-3, "drop_fraction": 0.4})
    study.optimize(objective, n_trials=2)
    first, second = (DQN.load(path) for path in sorted(tmp_path.rglob("CartPole-v1.zip")))
    for name, value in first.policy.state_dict().items():
        assert (value == second.policy.state_dict()[name]).all(), name
    assert study.trials[0].intermediate_values == study.trials[1].intermediate_values


def samples(sampler, count, study=None):
    study = study or optuna.create_study(sampler=sampler, direction="maximize")
    study.sampler = sampler
    for _ in range(count):
        study.optimize(lambda trial: SPACE.sample(trial)["learning_rate"], n_trials=1)
    return study, [trial.params for trial in study.trials]


@pytest.mark.parametrize("name", ["tpe", "random"])
def test_a_study_that_was_left_samples_as_if_it_had_not_been(name):
    _, whole = samples(sampler_of(name, SPACE, 1), 15)
    half, _ = samples(sampler_of(name, SPACE, 1), 12)
    _, both = samples(sampler_of(name, SPACE, 1), 3, half)
    assert both == whole
    _, other = samples(sampler_of(name, SPACE, 2), 15)
    assert all(a != b for a, b in zip(whole, other, strict=True))
    assert len({params["learning_rate"] for params in whole}) == 15


def test_a_sampler_is_made_for_each_trial():
    made = []

    def make(seed):
        made.append(seed)
        return optuna.samplers.RandomSampler(seed=seed)

    samples(SeededByTrial(make, 0), 5)
    assert len(set(made[1:])) == 5


@pytest.mark.parametrize(
    ("name", "evaluations", "at"),
    # The third trial is the worst of three at each step: where is it pruned first?
    [("none", 27, None), ("halving", 27, 3), ("hyperband", 27, 3)],
)
def test_pruners_let_a_bad_trial_go_on_to_their_first_rung(name, evaluations, at):
    # Hyperband puts trials into brackets by the study's name, which is random if none is given.
    pruner = pruner_of(name, evaluations)
    study = optuna.create_study(study_name="rungs", direction="maximize", pruner=pruner)

    def objective(trial):
        for step in range(1, evaluations + 1):
            trial.report(-float(trial.number), step)
            if trial.should_prune():
                raise optuna.TrialPruned
        return -float(trial.number)

    study.optimize(objective, n_trials=12)
    lasts = {trial.last_step for trial in study.trials if trial.state == TrialState.PRUNED}
    if at is None:
        assert not lasts
    else:
        assert min(lasts) == at
    assert study.trials[0].state == TrialState.COMPLETE


def test_the_median_pruner_waits_for_five_trials_and_a_third_of_a_trial():
    study = optuna.create_study(direction="maximize", pruner=pruner_of("median", 30))

    def objective(trial):
        for step in range(1, 31):
            trial.report(-float(trial.number), step)
            if trial.should_prune():
                raise optuna.TrialPruned
        return 0.0

    study.optimize(objective, n_trials=6)
    assert [trial.state for trial in study.trials[:5]] == [TrialState.COMPLETE] * 5
    assert study.trials[5].state == TrialState.PRUNED
    assert study.trials[5].last_step in (10, 11)


@pytest.mark.parametrize(
    ("run", "seeds", "message"),
    [
        ({}, 0, r"seeds must lie in \[1, 1000\], got 0"),
        (dict(n_timesteps=99), 1, "a run of 99 steps that is evaluated every 100 has no score"),
    ],
)
def test_mistakes(run, seeds, message):
    with pytest.raises(ConfigError, match=message):
        Objective(small_run(**run), choices(weight_decay=[0.0]), seeds)


def test_the_size_of_a_dense_network_is_not_tuned(tmp_path):
    with pytest.raises(ConfigError, match="--match-params trains one dense network"):
        tune(small_run(method="dense", match_params=0.9), log_folder=tmp_path)
    assert not list(tmp_path.iterdir())


def test_an_environment_that_does_not_work_is_found_before_any_worker(tmp_path):
    with pytest.raises(ConfigError, match="sac cannot act in CartPole-v1"):
        tune(small_run(algo="sac", hyperparams={}), log_folder=tmp_path)
    assert not list(tmp_path.iterdir())


MISSING = ["optuna", "ruamel.yaml", "matplotlib"]


def test_a_missing_extra_names_its_cure(tmp_path):
    code = "sys.modules[{!r}] = None\nfrom sb3_sparse.tuning import tune, write_report"
    forks = run_in_forks("import sb3_sparse", [code.format(name) for name in MISSING], tmp_path)
    for name, done in zip(MISSING, forks, strict=True):
        assert done.code == 1, name
        assert "sb3-sparse[" in done.err.splitlines()[-1], name
