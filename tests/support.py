"""What all tests share: small models and environments, and a method as a user might write it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm

import sb3_sparse
from sb3_sparse.topology import DropGrow, TopologyMethod, register, registry

OFF_POLICY = dict(learning_starts=20, buffer_size=1000, batch_size=16)


@register
class LeastIndex(DropGrow):
    """Third-party method of the tests: grows the lowest flat indices."""

    name = "least-index"

    def scores(self, layer, update, candidates, *, dense_grad):
        return -candidates.astype(np.float64)


@contextmanager
def registered(method: type[TopologyMethod]) -> Iterator[None]:
    """Make a method known for a while."""
    register(method)
    try:
        yield
    finally:
        registry._METHODS.pop(method.name)


class TinyImages(gym.Env):
    """36x36 images of noise."""

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, discrete: bool = True, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.observation_space = spaces.Box(0, 255, (36, 36, 1), np.uint8)
        self.action_space = spaces.Discrete(3) if discrete else spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._look(), {}

    def step(self, action):
        self.steps += 1
        return self._look(), float(self.np_random.normal()), self.steps >= 20, False, {}

    def _look(self):
        shape = self.observation_space.shape
        return self.np_random.integers(0, 256, shape, dtype=np.uint8)


class TinyDicts(TinyImages):
    """An image and a vector."""

    def __init__(self, discrete: bool = True, render_mode: str | None = None) -> None:
        super().__init__(discrete, render_mode)
        self.image = self.observation_space
        self.observation_space = spaces.Dict(
            {"image": self.image, "vector": spaces.Box(-9, 9, (5,), np.float32)}
        )

    def _look(self):
        image = self.np_random.integers(0, 256, self.image.shape, dtype=np.uint8)
        return {"image": image, "vector": self.np_random.normal(size=5).astype(np.float32)}


gym.register("TinyImages-v0", TinyImages)
gym.register("TinyDicts-v0", TinyDicts)

ALGORITHMS = {cls.__name__: cls for cls in sb3_sparse.supported_algorithms().values()}
DISCRETE = ("DQN", "QRDQN")


def run_command(monkeypatch, capsys, *arguments) -> tuple[int, str, str]:
    """Run ``sb3-sparse``; return its exit code, its output, and its errors."""
    from sb3_sparse import cli

    monkeypatch.setattr(sys, "argv", ["sb3-sparse", *map(str, arguments)])
    monkeypatch.setenv("COLUMNS", "300")
    code = 0
    try:
        cli.main()
    except SystemExit as stop:
        code = stop.code or 0
    said = capsys.readouterr()
    return code, said.out, said.err


def command(monkeypatch, capsys, *arguments) -> tuple[int, str]:
    """The same; return its exit code, and all that it says as one line."""
    code, out, err = run_command(monkeypatch, capsys, *arguments)
    return code, " ".join((out + err).split())


def arguments_of(algorithm: type[BaseAlgorithm]) -> dict[str, object]:
    """Constructor arguments that keep a test short."""
    name = algorithm.__name__
    if name in ("PPO", "TRPO"):
        return dict(n_steps=32, batch_size=16)
    if name == "A2C":
        return dict(n_steps=8)
    if name in DISCRETE:
        return dict(OFF_POLICY, train_freq=1, target_update_interval=20)
    return dict(OFF_POLICY)


storage = {"compute": "auto"}
"""Policy arguments that say how models of :func:`make` store their layers."""


def make(algorithm, env=None, policy="SparsePolicy", policy_kwargs=None, **kwargs) -> BaseAlgorithm:
    """A small seeded model on an environment that suits the algorithm."""
    if isinstance(algorithm, str):
        algorithm = ALGORITHMS[algorithm]
    if env is None:
        env = "CartPole-v1" if algorithm.__name__ in DISCRETE else "Pendulum-v1"
    few = {"n_quantiles": 20} if algorithm.__name__ == "QRDQN" else {}  # of 200 it compares pairs
    policy_kwargs = {"net_arch": [24, 24], **few, **(policy_kwargs or {})}
    if policy.startswith("Sparse"):
        policy_kwargs = {"sparsity": 0.9, **storage, **policy_kwargs}
    arguments = {**arguments_of(algorithm), "seed": 0, "device": "cpu", **kwargs}
    return algorithm(policy, env, policy_kwargs=policy_kwargs, **arguments)


def assert_masked(model: BaseAlgorithm) -> None:
    """Nothing inactive differs from 0: weights, targets that follow at once, moments."""
    sparse = model.policy.sparse
    soft = getattr(model, "tau", 1.0) < 1.0
    saved = model.policy.state_dict()
    names = {id(module): name for name, module in model.policy.named_modules()}
    for layer in sparse.layers:
        inactive = ~layer.mask().reshape(layer.shape)
        assert layer.nnz == int((~inactive).sum())
        np.testing.assert_array_equal(saved[f"{layer.name}.weight_mask"], ~inactive)
        assert not saved[f"{layer.name}.weight"][inactive].any(), layer.name
        for target in layer.targets:
            weight = saved[f"{names[id(target)]}.weight"]
            assert int((weight != 0).sum()) <= max(layer.nnz, layer.initial_nnz)
            if soft:
                assert not weight[inactive].any(), layer.name
        for optimizer in sparse.optimizers:
            for key, value in optimizer.state.get(layer.weight, {}).items():
                if value.shape == layer.weight.shape and value.dim():
                    moment = layer.saved_moment(value)
                    assert not moment[inactive].any(), (layer.name, key)
