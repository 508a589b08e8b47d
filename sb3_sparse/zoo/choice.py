"""Chooses the algorithm or the environment that a user leaves out."""

from __future__ import annotations

from collections.abc import Sequence

import gymnasium as gym
from gymnasium import spaces

from sb3_sparse.policies.registry import algorithm_names, registered
from sb3_sparse.zoo.environments import (
    import_packages,
    known_environment,
    mujoco_warns_once,
    plain_id,
)

FIRST = ("sac", "Pendulum-v1")
"""The run of ``sb3-sparse train`` without arguments: short, and good at its last step."""
DISCRETE, CONTINUOUS = "CartPole-v1", "Pendulum-v1"


def chosen(algo: str | None, env_id: str | None, packages: Sequence[str] = ()) -> tuple[str, str]:
    """Return an algorithm and an environment that suit each other.

    :param algo: algorithm in lower case; None: DQN if the environment's actions are discrete, SAC
        if they are continuous
    :param env_id: environment, as :class:`~sb3_sparse.zoo.spec.RunSpec` takes it; None:
        CartPole-v1 if the algorithm can act in it, else Pendulum-v1
    :param packages: modules that register environments or algorithms
    :raises ConfigError: if the environment is unknown or cannot be made
    """
    if algo is None and env_id is None:
        return FIRST
    if env_id is None:
        return str(algo), _environment_for(str(algo), packages)
    return algo or _algorithm_for(env_id, packages), env_id


def _environment_for(algo: str, packages: Sequence[str]) -> str:
    import_packages(packages)
    if algo not in [name.lower() for name in algorithm_names()]:
        return DISCRETE  # the run's specification says what is wrong
    (policy,) = (one.policy for name, one in registered().items() if name.lower() == algo)
    return DISCRETE if spaces.Discrete in policy.action_spaces else CONTINUOUS


def _algorithm_for(env_id: str, packages: Sequence[str]) -> str:
    env_id, packages = plain_id(env_id, packages)
    import_packages(packages)
    known_environment(env_id)
    from sb3_sparse.zoo.prepare import setup_errors

    failure = f"{env_id} cannot be made, to see which algorithm suits it; give --algo"
    with setup_errors(failure, env_id), mujoco_warns_once(env_id):
        env = gym.make(env_id)
        space = env.action_space
        env.close()
    return "sac" if isinstance(space, spaces.Box) else "dqn"
