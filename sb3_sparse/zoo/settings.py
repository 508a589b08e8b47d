"""Built-in settings: the RL zoo's tuned values for a few tasks, SB3's defaults for all others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from stable_baselines3.common.utils import LinearSchedule


@dataclass(frozen=True)
class Settings:
    """How to train one algorithm on one task.

    :param n_timesteps: environment steps
    :param n_envs: environments side by side
    :param algorithm: arguments of the algorithm's constructor
    :param policy: SB3's policy arguments
    :param update_interval: gradient steps between two mask updates
    :param drop_fraction: drop fraction at the first update
    """

    n_timesteps: int
    n_envs: int = 1
    algorithm: Mapping[str, Any] = field(default_factory=dict)
    policy: Mapping[str, Any] = field(default_factory=dict)
    update_interval: int = 1000
    drop_fraction: float = 0.5


# Source of the tuned values: rl-baselines3-zoo 2.9, hyperparams/. Mask settings: arXiv:2206.10369,
# tables of the best hyper-parameters (RigL).
TUNED: Mapping[tuple[str, str], Settings] = {
    ("dqn", "CartPole-v1"): Settings(
        n_timesteps=50_000,
        algorithm=dict(
            learning_rate=2.3e-3,
            batch_size=64,
            buffer_size=100_000,
            learning_starts=1000,
            gamma=0.99,
            target_update_interval=10,
            train_freq=256,
            gradient_steps=128,
            exploration_fraction=0.16,
            exploration_final_eps=0.04,
        ),
        policy=dict(net_arch=[256, 256]),
    ),
    ("ppo", "CartPole-v1"): Settings(
        n_timesteps=100_000,
        n_envs=8,
        algorithm=dict(
            n_steps=32,
            batch_size=256,
            gae_lambda=0.8,
            gamma=0.98,
            n_epochs=20,
            ent_coef=0.0,
            learning_rate=LinearSchedule(0.001, 0.0, 1.0),
            clip_range=LinearSchedule(0.2, 0.0, 1.0),
        ),
        update_interval=250,
        drop_fraction=0.3,
    ),
    ("sac", "Pendulum-v1"): Settings(n_timesteps=20_000, algorithm=dict(learning_rate=1e-3)),
    ("sac", "HalfCheetah-v5"): Settings(
        n_timesteps=1_000_000, algorithm=dict(learning_starts=10_000)
    ),
}
DEFAULT = Settings(n_timesteps=100_000)


def settings_for(algo: str, env_id: str) -> Settings:
    """The tuned settings of a task, or SB3's defaults for 100,000 steps."""
    return TUNED.get((algo, env_id), DEFAULT)
