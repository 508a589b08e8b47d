"""Trains small models with stock SB3 and with this package, and compares all that they hold."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

import sb3_sparse
import sb3_sparse.algorithms

NAMES = ("SAC", "TD3", "DDPG", "DQN", "PPO", "A2C", "TQC", "QRDQN", "CrossQ")
assert set(NAMES) == set(sb3_sparse.algorithms.__all__)
OFF_POLICY = ("SAC", "TD3", "DDPG", "DQN", "TQC", "QRDQN", "CrossQ")
DISCRETE = ("DQN", "QRDQN")
QUANTILES = ("TQC", "QRDQN")
STOCK = SimpleNamespace(**sb3_sparse.supported_algorithms())
"""The classes of SB3 and sb3-contrib."""
METHODS = ("static", "set", "rigl", "prune", "granet", "dense")
STORAGES = ("masked", "sparse", "auto")
BOX = spaces.Box(-1.0, 1.0, (3,))
VECTOR = spaces.Box(-1.0, 1.0, (5,))
STEPS = {"PPO": 96, "A2C": 100}
"""Environment steps that make thirty and twenty gradient steps; others take 40, for twenty."""


class Noise(gym.Env):
    """Observations and rewards are noise; episodes end and are cut off now and then."""

    def __init__(self, action_space: gym.Space, observation_space: gym.Space = VECTOR) -> None:
        self.action_space = action_space
        self.observation_space = observation_space
        self._random = np.random.default_rng(0)
        self._steps = 0

    def reset(self, *, seed=None, options=None):
        return self._look(), {}

    def step(self, action):
        self._steps += 1
        ends, is_cut_off = self._steps % 7 == 0, self._steps % 11 == 0
        return self._look(), float(self._random.normal()), ends, is_cut_off, {}

    def _look(self):
        self.observation_space.seed(int(self._random.integers(2**31)))
        return self.observation_space.sample()


def actions_of(name: str) -> gym.Space:
    return spaces.Discrete(4) if name in DISCRETE else BOX


def arguments_of(name: str) -> dict[str, Any]:
    """Constructor arguments for twenty or thirty gradient steps."""
    if name == "PPO":
        return dict(n_steps=32, batch_size=16, n_epochs=5)
    if name == "A2C":
        return dict(n_steps=5)
    common = dict(learning_starts=20, buffer_size=200, batch_size=70)
    if name == "CrossQ":
        return dict(common, learning_rate=3e-4, policy_delay=2)
    return dict(common, train_freq=1, target_update_interval=10) if name in DISCRETE else common


def make(library: Any, name: str, env: Any = None, **kwargs: Any) -> BaseAlgorithm:
    """A seeded model.

    :param library: ``STOCK`` or ``sb3_sparse``, or a class
    :param kwargs: of the algorithm; ``policy_kwargs`` are added to small ones
    """
    cls = getattr(library, name, library)
    policy_kwargs = {"sparsity": 0.7, "net_arch": [24, 16], **kwargs.pop("policy_kwargs", {})}
    if name in QUANTILES:
        policy_kwargs.setdefault("n_quantiles", 6)
    if name == "CrossQ":
        # A bias before a BatchRenorm may have gradient 0 but for rounding, of which Adam makes a
        # whole step with its usual epsilon.
        policy_kwargs.setdefault("optimizer_kwargs", dict(eps=1e-3))
    policy = kwargs.pop("policy", "SparsePolicy")
    if policy == "MlpPolicy":
        policy_kwargs.pop("sparsity")
    env = Noise(actions_of(name)) if env is None else env
    arguments = {**arguments_of(name), "seed": 3, "device": "cpu", **kwargs}
    return cls(policy, env, policy_kwargs=policy_kwargs, **arguments)


def learn(model: BaseAlgorithm, callback: Any = None, steps: int | None = None) -> BaseAlgorithm:
    """Twenty or thirty gradient steps, of which the logger keeps what it was told last."""
    name = next(name for name in NAMES[::-1] if isinstance(model, getattr(STOCK, name)))
    steps = steps or STEPS.get(name, 40)
    return model.learn(steps, callback, log_interval=10**9, reset_num_timesteps=False)


def moving(method: str, **kwargs: Any) -> BaseCallback | None:
    """A callback that moves masks often, or None where they do not move."""
    if method in ("static", "dense"):
        return None
    settings = {"update_interval": 2, "begin": 0.0, "end": 1.0, **kwargs}
    if method != "prune":
        settings["drop_fraction"] = 0.3
    return sb3_sparse.SparsityCallback(method, **settings)


def policy_kwargs_of(method: str, storage: str = "masked") -> dict[str, Any]:
    found: dict[str, Any] = {"compute": storage, "sparsity": 0.7}
    if method == "dense":
        found["sparsity"] = 0.0
    if method in ("prune", "granet"):
        found["initial_sparsity"] = 0.2
    return found


def optimizers_of(model: BaseAlgorithm) -> dict[str, th.optim.Optimizer]:
    policy = model.policy
    holders = {"policy": policy, "actor": getattr(policy, "actor", None)}
    holders["critic"] = getattr(policy, "critic", None)
    found = {name: getattr(holder, "optimizer", None) for name, holder in holders.items()}
    found["ent_coef"] = getattr(model, "ent_coef_optimizer", None)
    return {name: optimizer for name, optimizer in found.items() if optimizer is not None}


def tensors_of(model: BaseAlgorithm) -> dict[str, th.Tensor]:
    """Everything that training changes, by name."""
    found = {k: v for k, v in model.policy.state_dict().items() if isinstance(v, th.Tensor)}
    if getattr(model, "log_ent_coef", None) is not None:
        found["log_ent_coef"] = model.log_ent_coef.detach()
    for name, optimizer in optimizers_of(model).items():
        for number, state in optimizer.state_dict()["state"].items():
            for key, value in state.items():
                found[f"{name} optimizer {number} {key}"] = th.as_tensor(value)
    return {name: tensor.clone() for name, tensor in found.items()}


def logged_by(model: BaseAlgorithm) -> dict[str, Any]:
    """What was logged last."""
    kept = ("train/", "sparsity/")
    values = model.logger.name_to_value
    return {name: value for name, value in values.items() if name.startswith(kept)}


def assert_alike(ours: BaseAlgorithm, stock: BaseAlgorithm, exact: bool = False) -> None:
    """Weights, targets, moments, counters, masks, and logged values with their types.

    BatchRenorm magnifies the rounding of units that are rarely active, by up to five times the
    bounds of others when the weights of stock's CrossQ move by a unit in the last place.

    :param exact: bit for bit; else to rounding
    """
    magnified = 10 if type(ours).__name__ == "CrossQ" else 1
    assert ours._n_updates == stock._n_updates
    assert ours.num_timesteps == stock.num_timesteps
    one, two = tensors_of(ours), tensors_of(stock)
    assert one.keys() == two.keys()
    for name, tensor in one.items():
        assert tensor.dtype == two[name].dtype, name
        close = name.rpartition(" ")[2] != "step" and tensor.is_floating_point() and not exact
        relative = 1e-3 * magnified if " optimizer " in name else 0.0
        tolerance = dict(rtol=relative, atol=3e-5) if close else dict(rtol=0, atol=0)
        if close and relative:
            tolerance["atol"] = max(1e-9, 0.1 * relative * float(two[name].abs().max()))
        th.testing.assert_close(
            tensor, two[name], equal_nan=True, msg=lambda m, name=name: f"{name}: {m}", **tolerance
        )
    one, two = logged_by(ours), logged_by(stock)
    assert list(one) == list(two)
    for name, value in one.items():
        assert type(value) is type(two[name]), name
        bounds = dict(rtol=0, atol=0) if exact else dict(rtol=2e-4, atol=2e-6)
        np.testing.assert_allclose(value, two[name], err_msg=name, **bounds)


def fused(model: BaseAlgorithm) -> bool:
    """Whether gradient steps so far were programs."""
    training = model._trains()
    return training.reason is None and bool(training._machines)


def reason_of(model: BaseAlgorithm) -> str:
    """Why they were not."""
    reason = model._trains().reason
    assert reason is not None
    assert not model._trains()._machines
    return reason


def assert_like_stock(
    name: str, callback: Any = lambda: None, steps: int | None = None, env: Any = lambda: None,
    **kwargs: Any,
) -> tuple[BaseAlgorithm, BaseAlgorithm]:  # fmt: skip
    """Train ours and stock's with the same arguments, and compare; both models.

    :param callback: makes one for each model
    :param env: the same
    """
    models = []
    for library in (sb3_sparse, STOCK):
        arguments = {k: dict(v) if isinstance(v, dict) else v for k, v in kwargs.items()}
        models.append(learn(make(library, name, env(), **arguments), callback(), steps))
    ours, stock = models
    assert fused(ours), ours._trains().reason
    assert_alike(ours, stock)
    return ours, stock
