"""One training run, from names to a saved model."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_sparse.callback import SparsityCallback
from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.aliases import SparsePolicy, supported_algorithms
from sb3_sparse.policies.mixin import SparsePolicyMixin
from sb3_sparse.sparsity.distributions import check_distribution, check_sparsity
from sb3_sparse.topology import method_named, method_names
from sb3_sparse.zoo.checkpoint import BestCheckpoint
from sb3_sparse.zoo.settings import Settings, settings_for

DENSE = "dense"


@dataclass(frozen=True)
class Run:
    """What to train.

    :param algo: algorithm, e.g. ``"sac"``
    :param env_id: Gymnasium id
    :param method: ``"dense"`` (stock SB3) or a topology method
    :param sparsity: removed fraction, in [0, 1)
    :param distribution: ``"erk"``, ``"er"`` or ``"uniform"``
    :param seed: seed of everything
    :param n_timesteps: environment steps; None: as the settings say
    :raises ConfigError: for a name or value that is not allowed
    """

    algo: str = "dqn"
    env_id: str = "CartPole-v1"
    method: str = "rigl"
    sparsity: float = 0.9
    distribution: str = "erk"
    seed: int = 0
    n_timesteps: int | None = None

    def __post_init__(self) -> None:
        if self.algo not in algorithms():
            raise ConfigError(
                f"unknown algorithm {self.algo!r}; allowed are {', '.join(algorithms())} (tqc, "
                "qrdqn, crossq and trpo need sb3-sparse[contrib])"
            )
        if self.env_id not in gym.registry:
            raise ConfigError(
                f"unknown environment {self.env_id!r}; give a Gymnasium id, e.g. CartPole-v1"
            )
        if self.method != DENSE and self.method not in method_names():
            raise ConfigError(
                f"unknown method {self.method!r}; allowed are {DENSE}, {', '.join(method_names())}"
            )
        check_sparsity(self.sparsity)
        check_distribution(self.distribution)
        if self.n_timesteps is not None and self.n_timesteps < 1:
            raise ConfigError(f"the number of steps must be 1 or more, got {self.n_timesteps}")
        if not 0 <= self.seed < 2**31:
            raise ConfigError(f"the seed must lie in [0, 2^31), got {self.seed}")

    @property
    def settings(self) -> Settings:
        """The built-in settings of this task."""
        return settings_for(self.algo, self.env_id)

    @property
    def steps(self) -> int:
        """Environment steps."""
        return self.n_timesteps or self.settings.n_timesteps


@dataclass(frozen=True)
class Result:
    """What came out.

    :param what: which policy of the run
    :param mean_return: mean episode return of the deterministic policy
    :param std_return: its standard deviation over episodes
    :param path: where the model lies
    """

    what: str
    mean_return: float
    std_return: float
    path: Path


def algorithms() -> dict[str, type[BaseAlgorithm]]:
    """Supported algorithms by lower-case name."""
    return {name.lower(): algorithm for name, algorithm in supported_algorithms().items()}


def make_model(run: Run, env: VecEnv, **kwargs: Any) -> tuple[BaseAlgorithm, list[BaseCallback]]:
    """The model and the callbacks that the run needs.

    :param kwargs: further arguments of the algorithm's constructor
    """
    settings = run.settings
    policy_kwargs = dict(settings.policy)
    callbacks: list[BaseCallback] = []
    if run.method == DENSE:
        policy = stock_policy(env.observation_space)
    else:
        policy = SparsePolicy
        policy_kwargs.update(sparsity=run.sparsity, distribution=run.distribution)
        method = method_named(run.method)
        if method.reaches_final:
            policy_kwargs["initial_sparsity"] = 0.0
        options = {
            name: getattr(settings, name)
            for name in ("update_interval", "drop_fraction")
            if name in method.options
        }
        callbacks.append(SparsityCallback(run.method, **options))
    algorithm: Any = algorithms()[run.algo]
    arguments = {**settings.algorithm, **kwargs}
    model = algorithm(policy, env, seed=run.seed, policy_kwargs=policy_kwargs, **arguments)
    return model, callbacks


def stock_policy(observation_space: spaces.Space[Any]) -> str:
    """The name of SB3's own policy for these observations."""
    if isinstance(observation_space, spaces.Dict):
        return "MultiInputPolicy"
    return "CnnPolicy" if is_image_space(observation_space) else "MlpPolicy"


def make_env(run: Run) -> VecEnv:
    """The run's environments, seeded.

    :raises ConfigError: if the environment cannot be made or the algorithm cannot act in it
    """
    try:
        env = make_vec_env(run.env_id, n_envs=run.settings.n_envs, seed=run.seed)
    except gym.error.DependencyNotInstalled as error:
        raise ConfigError(
            f"{run.env_id} cannot be made: {error}; MuJoCo tasks need sb3-sparse[mujoco], Atari "
            "games sb3-sparse[atari]"
        ) from error
    discrete_only = run.algo in ("dqn", "qrdqn")
    box_only = run.algo in ("sac", "td3", "ddpg", "tqc", "crossq")
    discrete = isinstance(env.action_space, spaces.Discrete)
    if (discrete_only and not discrete) or (
        box_only and not isinstance(env.action_space, spaces.Box)
    ):
        raise ConfigError(
            f"{run.algo} cannot act in {run.env_id}, whose actions are {env.action_space}; "
            + (
                "take dqn, qrdqn, ppo, a2c or trpo"
                if discrete
                else "take sac, td3, tqc, crossq, ppo, a2c or trpo"
            )
        )
    return env


def evaluate(model: BaseAlgorithm, run: Run, episodes: int) -> tuple[float, float]:
    """Mean and standard deviation of the deterministic policy's return on fresh environments."""
    env = make_vec_env(run.env_id, n_envs=1, seed=run.seed + 10_000)
    try:
        mean, std = evaluate_policy(model, env, n_eval_episodes=episodes, deterministic=True)
    finally:
        env.close()
    assert isinstance(mean, float)
    assert isinstance(std, float)
    return mean, std


def train(
    run: Run,
    log_folder: Path,
    callbacks: list[BaseCallback],
    episodes: int = 20,
) -> tuple[BaseAlgorithm, list[Result]]:
    """Train, save, evaluate the last policy and the best checkpoint.

    The model is saved before it is evaluated, and as far as it came when training is interrupted.

    :param log_folder: a folder of its own is made below it, as the RL zoo names it:
        ``<algo>/<env>_<number>``
    :param callbacks: further callbacks
    :param episodes: episodes of the evaluation
    """
    env = make_env(run)
    try:
        use_few_threads(env.observation_space)
        model, own = make_model(run, env)
        folder = new_run_folder(log_folder / run.algo, run.env_id)
        path = folder / f"{run.env_id}.zip"
        eval_env = make_vec_env(run.env_id, n_envs=1, seed=run.seed + 20_000)
        best = BestCheckpoint(eval_env, folder)
        try:
            model.learn(run.steps, callback=[*own, *callbacks, best])
        except KeyboardInterrupt:
            print(
                f"\nInterrupted after {model.num_timesteps} steps; saving {path}", file=sys.stderr
            )
            raise
        finally:
            model.save(path)
            eval_env.close()
        results = [Result("Last policy", *evaluate(model, run, episodes), path)]
        if best.path.exists():
            kept = type(model).load(best.path, device=model.device)
            results.append(Result("Best checkpoint", *evaluate(kept, run, episodes), best.path))
    finally:
        env.close()
    return model, results


def use_few_threads(observation_space: spaces.Space[Any]) -> None:
    """One thread for networks without convolutions, which more threads only slow down.

    ``OMP_NUM_THREADS`` decides where it is set.
    """
    if "OMP_NUM_THREADS" not in os.environ and stock_policy(observation_space) == "MlpPolicy":
        th.set_num_threads(1)


def new_run_folder(parent: Path, env_id: str) -> Path:
    """Make and return ``parent/<env>_<n>`` with the next free number."""
    taken = [
        int(number)
        for folder in parent.glob(f"{env_id}_*")
        if (number := folder.name.removeprefix(f"{env_id}_")).isdigit()
    ]
    folder = parent / f"{env_id}_{max(taken, default=0) + 1}"
    folder.mkdir(parents=True)
    return folder


def reached_sparsity(model: BaseAlgorithm) -> float | None:
    """Sparsity of a model now; None if its policy is a stock one."""
    policy = model.policy
    return policy.sparse.sparsity if isinstance(policy, SparsePolicyMixin) else None
