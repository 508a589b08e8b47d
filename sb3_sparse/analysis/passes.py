"""How often each network is run in one gradient step of an algorithm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_sparse.algorithms.table import trainer_of
from sb3_sparse.errors import ConfigError


@dataclass(frozen=True)
class PassCounts:
    """Runs of one network in one gradient step, on average and for each sample of the minibatch.

    :param network: its name
    :param forward: forward passes
    :param backward: backward passes that give the gradient of its weights; each costs 2 forward
    :param through: backward passes that only hand a gradient on to the network's actions; each
        costs 1 forward, without the features extractor
    :param target: whether it is the target copy that is run
    :param leaves_out: name pattern of layers that are not run
    :param shares: whether a layer shared with another network is run again for this one
    """

    network: str
    forward: float = 1.0
    backward: float = 0.0
    through: float = 0.0
    target: bool = False
    leaves_out: str = ""
    shares: bool = True


def _value_based(network: str) -> Callable[[Any], list[PassCounts]]:
    return lambda model: [PassCounts(network, 1, 1), PassCounts(network, 1, target=True)]


def _sac(model: Any) -> list[PassCounts]:
    return [
        PassCounts("actor", 2, 1),  # of the observations, and of the next ones
        PassCounts("critic", 1, 1),
        PassCounts("critic", 1, through=1),  # of the actor's actions
        PassCounts("critic", 1, target=True),
    ]


def _td3(model: Any) -> list[PassCounts]:
    share = 1 / model.policy_delay
    return [
        PassCounts("actor", 1, target=True),
        PassCounts("critic", 1, target=True),
        PassCounts("critic", 1, 1),
        PassCounts("actor", share, share),
        PassCounts(
            "critic", share, through=share, leaves_out="critic.qf[!0]*"
        ),  # the first of them
    ]


def _crossq(model: Any) -> list[PassCounts]:
    share = 1 / model.policy_delay
    return [
        PassCounts("actor", 1),
        PassCounts("critic", 2, 2),  # observations and next ones in one minibatch of twice the size
        PassCounts("actor", share, share),
        PassCounts("critic", share, through=share),
    ]


def _actor_critic(model: Any) -> list[PassCounts]:
    return [PassCounts("actor", 1, 1, shares=False), PassCounts("critic", 1, 1, shares=False)]


# By name, because sb3_contrib may be absent.
PASSES: dict[str, Callable[[Any], list[PassCounts]]] = {
    "DQN": _value_based("q_net"),
    "QRDQN": _value_based("quantile_net"),
    "SAC": _sac,
    "TQC": _sac,
    "TD3": _td3,
    "CrossQ": _crossq,
    "PPO": _actor_critic,
    "A2C": _actor_critic,
}


def passes_of(model: BaseAlgorithm) -> list[PassCounts]:
    """The passes of one gradient step, with the model's own settings.

    :raises ConfigError: for an algorithm whose ``train()`` is none of the known ones
    """
    trainer = trainer_of(type(model))
    known = trainer.__module__.startswith(("stable_baselines3.", "sb3_contrib."))
    if known and trainer.__name__ in PASSES:
        return PASSES[trainer.__name__](model)
    raise ConfigError(
        f"how often {type(model).__name__} runs its networks in a gradient step is not known; it "
        f"is for {', '.join(PASSES)} and DDPG. flops(model.policy) counts forward passes alone"
    )


def batch_size_of(model: Any) -> int:
    """Samples of the model's minibatch."""
    if hasattr(model, "batch_size"):
        return int(model.batch_size)
    return int(model.n_steps * model.n_envs)  # A2C takes the whole rollout
