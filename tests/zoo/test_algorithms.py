"""Which classes the commands train and load: this package's where there is one."""

from __future__ import annotations

import signal

import numpy as np
import pytest
import stable_baselines3
from algorithms_support import NAMES
from rl_zoo3.utils import ALGOS
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from support import ALGORITHMS, make

import sb3_sparse
from sb3_sparse.algorithms.table import trainer_of
from sb3_sparse.zoo.saved import SavedModel
from sb3_sparse.zoo.spec import RunSpec, algorithms
from sb3_sparse.zoo.training import resume, train

SMALL = {"net_arch": [16, 16], "batch_size": 16, "learning_starts": 50, "update_interval": 20}
RUN = RunSpec(n_timesteps=300, hyperparams=SMALL, eval_freq=100, eval_episodes=1)


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_the_class_of_an_algorithm_is_ours_where_there_is_one(name):
    found = algorithms()[name.lower()]
    assert found is (getattr(sb3_sparse, name) if name in NAMES else ALGORITHMS[name])
    assert found.__name__ == name
    assert issubclass(found, ALGORITHMS[name])
    assert RunSpec(name.lower(), "CartPole-v1").algorithm is found
    assert ALGOS[name.lower()] is ALGORITHMS[name]  # rl-zoo's own commands go on with those


class CtrlC(BaseCallback):
    def _on_step(self) -> bool:
        if self.num_timesteps == 200:
            signal.raise_signal(signal.SIGINT)
        return True


def test_runs_train_and_go_on_with_our_class(tmp_path):
    stopped = train(RUN, tmp_path, [CtrlC()])
    assert type(stopped.model) is sb3_sparse.DQN
    outcome = resume(stopped.folder)
    assert outcome.finished
    assert type(outcome.model) is sb3_sparse.DQN
    assert outcome.model.num_timesteps == 300
    saved = SavedModel.find(stopped.folder)
    assert type(saved.load()) is sb3_sparse.DQN
    assert type(saved.load(make_vec_env("CartPole-v1"))) is sb3_sparse.DQN
    observation = np.zeros(4, np.float32)
    assert saved.policy().predict(observation)[0] in (0, 1)
    stock = stable_baselines3.DQN.load(saved.path)
    assert stock.num_timesteps == 300


@pytest.mark.parametrize("name", ["SAC", "TQC"])
def test_files_of_stock_algorithms_load(tmp_path, name):
    make(name).save(tmp_path / "model.zip")
    loaded = SavedModel.find(tmp_path / "model.zip").load(make_vec_env("Pendulum-v1"))
    assert type(loaded) is algorithms()[name.lower()]
    loaded.learn(30)


@pytest.mark.parametrize("name", NAMES)
def test_what_trains_ours_is_what_trains_stock(name):
    assert trainer_of(getattr(sb3_sparse, name)) is trainer_of(ALGORITHMS[name])


def test_what_trains_a_users_class_is_that_class():
    class Mine(sb3_sparse.SAC):
        def train(self, gradient_steps: int, batch_size: int = 64) -> None:
            """Learn nothing."""

    class Same(sb3_sparse.SAC):
        """Learns as SAC does."""

    assert trainer_of(Mine) is Mine
    assert trainer_of(Same) is stable_baselines3.SAC
