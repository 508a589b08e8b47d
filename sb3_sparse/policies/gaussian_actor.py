"""The squashed Gaussian of SAC's actor, as one node of the graph.

SB3's distribution takes a tenth of a small actor's gradient step: some forty small operations with
their checks. Here, one function samples and computes the log probability from the same random
numbers, and its gradient has a closed form.
"""

from __future__ import annotations

import math
from typing import Any

import torch as th
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN
from torch.autograd.function import once_differentiable

from sb3_sparse.engine.gaussian import sample_squashed
from sb3_sparse.policies.fast_distributions import LazyDistribution
from sb3_sparse.policies.fast_predict import Actions
from sb3_sparse.policies.modules import ActingModule

LOG_OF_ROOT_OF_TWO_PI = 0.5 * math.log(2.0 * math.pi)


class _SampleAndLogProb(th.autograd.Function):
    """``a = tanh(u)`` with ``u = mean + std * noise``, and ``log p(a)`` as SB3 has it.

    ``log p(a) = sum(-noise^2 / 2 - log_std - log(2 pi) / 2 - log(1 - a^2 + epsilon))``
    """

    @staticmethod
    def forward(
        ctx: Any, mean: th.Tensor, log_std: th.Tensor, epsilon: float
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        noise = th.randn(mean.shape, dtype=mean.dtype, device=mean.device)
        spread = log_std.exp() * noise
        gaussian = mean + spread
        action = gaussian.tanh()
        slope = 1.0 - action.square()
        inside = slope + epsilon
        density = noise.square().mul_(0.5).add_(log_std).add_(inside.log())
        log_prob = density.sum(dim=1).neg_().sub_(mean.shape[1] * LOG_OF_ROOT_OF_TWO_PI)
        ctx.save_for_backward(action, slope, inside, spread)
        ctx.mark_non_differentiable(gaussian)
        return action, log_prob, gaussian

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Any) -> Any:
        grad_action, grad_log_prob, _ = gradients
        action, slope, inside, spread = ctx.saved_tensors
        grad_log_prob = grad_log_prob.unsqueeze(1)
        grad = (2.0 * grad_log_prob) * action / inside
        grad = grad.add_(grad_action).mul_(slope)
        return grad, grad * spread - grad_log_prob, None


class FastSquashedGaussian(LazyDistribution, SquashedDiagGaussianDistribution):
    """SB3's distribution with a faster ``log_prob_from_params``, and :meth:`act`."""

    def log_prob_from_params(
        self, mean_actions: th.Tensor, log_std: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """As in SB3: an action and its log probability, shapes ``(n, dim)`` and ``(n,)``."""
        action, log_prob, self.gaussian_actions = _SampleAndLogProb.apply(  # type: ignore[no-untyped-call]
            mean_actions, log_std, self.epsilon
        )
        if log_prob.isnan().any():  # SB3's own raises the error
            return super().log_prob_from_params(mean_actions, log_std)
        self.remember(mean_actions, log_std)
        return action, log_prob

    def act(self, mean: th.Tensor, log_std: th.Tensor, deterministic: bool) -> th.Tensor | None:
        """The actions that SB3 samples from the same random numbers, without a graph.

        :param mean: shape ``(n, dim)``
        :param log_std: the same shape; clamped to SB3's bounds in place
        :return: shape ``(n, dim)``; None if one is not finite
        """
        noise = None
        if not deterministic:
            noise = th.randn(mean.shape, dtype=th.float32, device="cpu")
        acted = sample_squashed(mean, log_std, (LOG_STD_MIN, LOG_STD_MAX), noise)
        if acted is None:
            return None
        self.remember(mean, log_std)
        self.gaussian_actions, actions = acted
        return actions


class GaussianActor(ActingModule):
    """Actor of SAC, TQC and CrossQ."""

    paths = (("latent_pi", "mu"), ("latent_pi", "log_std"))
    bypassed = ("get_action_dist_params",)
    use_sde: bool

    def use_kernels(self) -> None:
        """Act and sample in fewer steps from now on; gSDE stays SB3's own."""
        if self.use_sde:
            return
        super().use_kernels()
        distribution = vars(self).get("action_dist")
        if type(distribution) is SquashedDiagGaussianDistribution:
            fast = FastSquashedGaussian(distribution.action_dim, distribution.epsilon)
            vars(self)["action_dist"] = fast

    def forward(self, obs: Any, deterministic: bool = False) -> th.Tensor:
        """As in SB3: actions of shape ``(n, dim)``."""
        results = self.results(obs)
        actions = None if results is None else self._act(results, deterministic)
        if actions is not None:
            return actions
        found: th.Tensor = super().forward(obs, deterministic)
        return found

    def actions_from(self, results: list[Actions], deterministic: bool) -> Actions | None:
        """Squashed actions, shape ``(n, dim)``."""
        actions = self._act(list(map(th.from_numpy, results)), deterministic)
        return None if actions is None else actions.numpy()

    def _act(self, results: list[th.Tensor], deterministic: bool) -> th.Tensor | None:
        if not isinstance(self.action_dist, FastSquashedGaussian):
            return None
        mean, log_std = results
        return self.action_dist.act(mean, log_std, deterministic)
