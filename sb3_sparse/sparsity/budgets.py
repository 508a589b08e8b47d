"""Share one sparsity budget between the actor and the critics."""

from __future__ import annotations

import math

from sb3_sparse.errors import ConfigError
from sb3_sparse.sparsity.distributions import check_sparsity
from sb3_sparse.sparsity.numeric import is_number


def feasible_actor_share(
    actor_size: float, critics_size: float, sparsity: float
) -> tuple[float, float]:
    """Smallest and largest actor share at which no network would get more than it has.

    :param actor_size: connections of the dense actor
    :param critics_size: connections of all dense critics together
    :param sparsity: removed fraction over actor and critics together, in [0, 1)
    """
    budget = (1.0 - sparsity) * (actor_size + critics_size)
    return max(0.0, 1.0 - critics_size / budget), min(1.0, actor_size / budget)


def _rounded_up(low: float) -> float:
    """The smallest feasible number with four decimals, above 0."""
    return max(1, math.ceil(low * 1e4 - 1e-9)) / 1e4


def _rounded_down(high: float) -> float:
    """The largest feasible number with four decimals, below 1."""
    return min(9999, math.floor(high * 1e4 + 1e-9)) / 1e4


def split_sparsity(
    actor_size: int, critics_size: int, sparsity: float, actor_share: float
) -> tuple[float, float]:
    """Sparsity of the actor and of each critic for one common budget.

    Both are equally sparse at ``actor_share = actor_size / (actor_size + critics_size)``.

    Example::

        from sb3_sparse.sparsity import split_sparsity

        split_sparsity(72960, 143360, sparsity=0.9, actor_share=0.5)  # (0.8517, 0.9246)

    :param actor_size: connections of the dense actor
    :param critics_size: connections of all dense critics together (two critics count twice)
    :param sparsity: removed fraction over actor and critics together, in [0, 1)
    :param actor_share: fraction of the remaining connections that the actor gets, in (0, 1)
    :return: ``(actor sparsity, critic sparsity)``
    :raises ConfigError: if a network would get more connections than it has, or none

    Source: arXiv:2206.10369, figure on the actor-critic ratio.
    """
    sparsity = check_sparsity(sparsity)
    if not is_number(actor_share):
        raise ConfigError(f"actor_share must be a number in (0, 1), got {actor_share!r}")
    low, high = feasible_actor_share(actor_size, critics_size, sparsity)
    budget = (1.0 - sparsity) * (actor_size + critics_size)
    actor = 1.0 - actor_share * budget / actor_size
    critic = 1.0 - (1.0 - actor_share) * budget / critics_size
    # A share at the very edge of what is feasible may miss it by rounding.
    actor, critic = (0.0 if -1e-9 < value < 0.0 else value for value in (actor, critic))
    if not (0.0 <= actor < 1.0 and 0.0 <= critic < 1.0):
        raise ConfigError(
            f"actor_share={actor_share} is infeasible at sparsity {sparsity}: it would ask for a "
            f"sparsity of {actor:.4f} in the actor and {critic:.4f} in the critic; choose "
            f"actor_share between {_rounded_up(low)} and {_rounded_down(high)}"
        )
    return actor, critic
