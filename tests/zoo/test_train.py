"""One training run, called from Python."""

from __future__ import annotations

import pytest
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback
from support import ALGORITHMS

from sb3_sparse.errors import ConfigError
from sb3_sparse.zoo.settings import DEFAULT, TUNED, settings_for
from sb3_sparse.zoo.train import Run, algorithms, make_env, make_model, new_run_folder, train


class Interrupt(BaseCallback):
    def _on_step(self) -> bool:
        if self.num_timesteps == 300:
            raise KeyboardInterrupt
        return True


def test_an_interrupted_run_leaves_its_model_behind(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        train(Run(n_timesteps=1000), tmp_path, [Interrupt()])
    model = DQN.load(tmp_path / "dqn" / "CartPole-v1_1" / "CartPole-v1.zip")
    assert model.num_timesteps == 300


@pytest.mark.parametrize(("algo", "method"), [("ppo", "prune"), ("dqn", "prune"), ("ppo", "dense")])
def test_the_best_checkpoint_is_pruned_and_one_of_ten(algo, method, tmp_path, monkeypatch):
    evaluated = []
    monkeypatch.setattr(
        "stable_baselines3.common.callbacks.evaluate_policy",
        lambda model, *args, **kwargs: (evaluated.append(model.num_timesteps), ([1.0], [1]))[1],
    )
    _, results = train(Run(algo, method=method, n_timesteps=2000), tmp_path, [])
    assert 1 <= len(evaluated) <= 10
    assert all(1600 < steps <= 2000 for steps in evaluated)
    for result in results:
        model = algorithms()[algo].load(result.path)
        if method == "prune":
            assert all(layer.nnz == layer.final_nnz for layer in model.policy.sparse.layers)


def test_folders_are_numbered_on_and_never_shared(tmp_path):
    (tmp_path / "A-v1_7").mkdir()
    (tmp_path / "A-v1_old").mkdir()
    assert new_run_folder(tmp_path, "A-v1").name == "A-v1_8"
    assert new_run_folder(tmp_path, "A-v1").name == "A-v1_9"
    assert new_run_folder(tmp_path, "B-v1").name == "B-v1_1"


@pytest.mark.parametrize("task", sorted(TUNED))
def test_every_built_in_setting_makes_a_model(task):
    algo, env_id = task
    run = Run(algo=algo, env_id=env_id, method="prune")
    env = make_env(run)
    model, callbacks = make_model(run, env)
    assert model.n_envs == run.settings.n_envs
    assert callbacks[0].plan.update_interval == run.settings.update_interval
    env.close()


def test_other_tasks_get_the_defaults_of_sb3():
    assert settings_for("sac", "Hopper-v5") is DEFAULT
    assert not DEFAULT.algorithm


def test_the_algorithms_are_those_with_a_sparse_policy():
    assert set(algorithms()) == {name.lower() for name in ALGORITHMS}


def test_a_negative_seed_is_refused():
    with pytest.raises(ConfigError, match="seed must lie in"):
        Run(seed=-1)
