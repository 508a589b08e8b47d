"""SB3's action distributions, without the objects of ``torch.distributions`` while acting."""

from __future__ import annotations

from typing import Any

import torch as th
from stable_baselines3.common.distributions import (
    CategoricalDistribution,
    DiagGaussianDistribution,
    Distribution,
)

from sb3_sparse.engine.gaussian import sample_gaussian


class LazyDistribution:
    """Makes the attribute ``distribution`` only when it is read, of the last parameters."""

    def remember(self, *parameters: th.Tensor) -> None:
        """Set the parameters, which are the arguments of SB3's ``proba_distribution``."""
        self._last = parameters
        vars(self).pop("distribution", None)

    def __getattr__(self, name: str) -> Any:
        last = vars(self).get("_last")
        if name != "distribution" or last is None:
            raise AttributeError(name)
        self.proba_distribution(*last)
        return vars(self)["distribution"]


class FastGaussian(LazyDistribution, DiagGaussianDistribution):
    """SB3's Gaussian for PPO and A2C, with a faster way to :meth:`act`."""

    def act(
        self, mean: th.Tensor, log_std: th.Tensor, deterministic: bool
    ) -> tuple[th.Tensor, th.Tensor] | None:
        """The actions that SB3 samples from the same random numbers, without a graph.

        :param mean: shape ``(n, dim)``
        :param log_std: shape ``(dim,)``
        :return: actions ``(n, dim)`` and their log probabilities ``(n,)``; None if one is not
            finite, or for a ``log_std`` that the kernels cannot read
        """
        n, size = mean.shape
        if (
            log_std.shape != (size,)
            or log_std.dtype != th.float32
            or not log_std.is_cpu
            or not log_std.is_contiguous()
        ):
            return None  # the user has set another one, which torch can read
        noise = None if deterministic else th.randn((n, size), dtype=th.float32, device="cpu")
        acted = sample_gaussian(mean, log_std, noise)
        if acted is not None:
            self.remember(mean, log_std.detach())
        return acted


class FastCategorical(LazyDistribution, CategoricalDistribution):
    """SB3's categorical distribution for PPO and A2C, with a faster way to :meth:`act`."""

    def act(self, logits: th.Tensor, deterministic: bool) -> tuple[th.Tensor, th.Tensor] | None:
        """The actions that SB3 samples from the same random numbers, without a graph.

        :param logits: shape ``(n, actions)``
        :return: actions and their log probabilities, shapes ``(n,)``
        """
        log_probs = logits.log_softmax(dim=1)
        probs = log_probs.exp()
        if deterministic:
            actions = probs.argmax(dim=1, keepdim=True)
        else:
            actions = th.multinomial(probs, 1, True)
        self.remember(logits)
        return actions.squeeze(1), log_probs.gather(1, actions).squeeze(1)


def fast_distribution(distribution: Distribution) -> Distribution:
    """A fast distribution in place of SB3's own; any other is returned as it is."""
    if type(distribution) is DiagGaussianDistribution:
        return FastGaussian(distribution.action_dim)
    if type(distribution) is CategoricalDistribution:
        return FastCategorical(distribution.action_dim)
    return distribution
