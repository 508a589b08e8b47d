"""How a process that trains computes."""

from __future__ import annotations

import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sparse.zoo.computing import denormals_as_zero, use_few_threads
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.training import train

VECTOR = spaces.Box(-1.0, 1.0, (4,))


def product() -> float:
    """1e-40, which is denormal."""
    return float(th.tensor([1e-38]) * 1e-2)


def test_denormal_results_become_zero_and_afterwards_they_are_as_before():
    assert product() == pytest.approx(1e-40, rel=1e-3)
    with denormals_as_zero():
        assert product() == 0.0
        with denormals_as_zero():
            pass
        assert product() == 0.0
    assert product() == pytest.approx(1e-40, rel=1e-3)


class Products(BaseCallback):
    seen: list[float]

    def _on_training_start(self):
        self.seen = []

    def _on_step(self):
        self.seen.append(product())
        return True


def test_a_run_trains_without_them_and_leaves_the_process_as_it_was(tmp_path):
    products = Products()
    run = RunSpec(n_timesteps=20, eval_freq=20, eval_episodes=1, hyperparams={"net_arch": [4]})
    train(run, tmp_path, [products])
    assert set(products.seen) == {0.0}
    assert product() > 0.0


def test_vectors_get_one_thread(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    threads = th.get_num_threads()
    th.set_num_threads(2)
    use_few_threads(VECTOR)
    assert th.get_num_threads() == 1
    th.set_num_threads(threads)
