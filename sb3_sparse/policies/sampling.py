"""What SB3's distributions sample while acting, without the objects of ``torch.distributions``."""

from __future__ import annotations

from typing import Any

import torch as th
from stable_baselines3.common.distributions import (
    CategoricalDistribution,
    DiagGaussianDistribution,
    Distribution,
)

from sb3_sparse.engine.gaussian import gaussian


class MadeLater:
    """Makes ``distribution`` when somebody asks for it, out of the last parameters."""

    def remember(self, *parameters: th.Tensor) -> None:
        """Be the distribution of these parameters of SB3's ``proba_distribution``."""
        self._last = parameters
        vars(self).pop("distribution", None)

    def __getattr__(self, name: str) -> Any:
        last = vars(self).get("_last")
        if name != "distribution" or last is None:
            raise AttributeError(name)
        self.proba_distribution(*last)
        return vars(self)["distribution"]


class QuickGaussian(MadeLater, DiagGaussianDistribution):
    """SB3's distribution for PPO and A2C with another :meth:`act`; everything else is SB3's."""

    def act(
        self, mean: th.Tensor, log_std: th.Tensor, deterministic: bool
    ) -> tuple[th.Tensor, th.Tensor] | None:
        """Actions and their log probabilities, shapes ``(n, dim)`` and ``(n,)``, without a graph.

        They are those of SB3, of the same random numbers. None if a result is not finite,
        or for a ``log_std`` that the kernels cannot read.

        :param mean: shape ``(n, dim)``
        :param log_std: shape ``(dim,)``
        """
        n, size = mean.shape
        if (
            log_std.shape != (size,)
            or log_std.dtype != th.float32
            or not log_std.is_cpu
            or not log_std.is_contiguous()
        ):
            return None  # somebody has set another one, and torch knows what to do with it
        noise = None if deterministic else th.randn((n, size), dtype=th.float32, device="cpu")
        acted = gaussian(mean, log_std, noise)
        if acted is not None:
            self.remember(mean, log_std.detach())
        return acted


class QuickCategorical(MadeLater, CategoricalDistribution):
    """SB3's distribution for PPO and A2C with another :meth:`act`; everything else is SB3's."""

    def act(self, logits: th.Tensor, deterministic: bool) -> tuple[th.Tensor, th.Tensor] | None:
        """Actions and their log probabilities, shapes ``(n,)``, without a graph.

        :param logits: shape ``(n, actions)``
        """
        log_probs = logits.log_softmax(dim=1)
        probs = log_probs.exp()
        if deterministic:
            actions = probs.argmax(dim=1, keepdim=True)
        else:
            actions = th.multinomial(probs, 1, True)
        self.remember(logits)
        return actions.squeeze(1), log_probs.gather(1, actions).squeeze(1)


def quick(distribution: Distribution) -> Distribution:
    """A quick distribution in place of SB3's own; any other as it is."""
    if type(distribution) is DiagGaussianDistribution:
        return QuickGaussian(distribution.action_dim)
    if type(distribution) is CategoricalDistribution:
        return QuickCategorical(distribution.action_dim)
    return distribution
