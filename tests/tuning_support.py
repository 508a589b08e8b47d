"""Small runs to tune, and what to search in them."""

from __future__ import annotations

from sb3_sparse.tuning import Space
from sb3_sparse.tuning.backend import optuna
from sb3_sparse.zoo.spec import RunSpec


def small_run(**changes) -> RunSpec:
    """A run of a second."""
    settings = dict(
        n_timesteps=600,
        eval_freq=100,
        eval_episodes=2,
        hyperparams={"net_arch": [16], "learning_starts": 50, "buffer_size": 1000},
    )
    return RunSpec(**{**settings, **changes})


def choices(**lists) -> Space:
    """A grid."""
    of = optuna.distributions.CategoricalDistribution
    return Space("small", {name: of(values) for name, values in lists.items()})
