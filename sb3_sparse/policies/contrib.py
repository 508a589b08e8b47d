"""Sparse policies of sb3-contrib: TQC, QR-DQN and CrossQ."""

from __future__ import annotations

from functools import partial
from importlib.util import find_spec
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_sparse.engine.internals import become
from sb3_sparse.engine.norms import NORMS
from sb3_sparse.errors import MissingExtra
from sb3_sparse.policies.actor_critic import SparseActorCriticPolicy
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.critics import SparseCritic, SparseCriticsMixin
from sb3_sparse.policies.dqn import value_passes
from sb3_sparse.policies.fast_predict import Actions
from sb3_sparse.policies.gaussian_actor import GaussianActor
from sb3_sparse.policies.modules import ActingModule, PredictsByModule
from sb3_sparse.policies.registry import (
    register_policy,
    register_variant,
    reject,
    reject_variant,
    variants_of,
)
from sb3_sparse.policies.sac import GAUSSIAN_ACTING, GAUSSIAN_ACTOR, TWIN_CRITIC, sac_passes
from sb3_sparse.policies.simba import SimbaActingModule, SimbaCritic, SimbaPolicy
from sb3_sparse.policies.spec import NetworkSpec, PassCounts

if find_spec("sb3_contrib") is None:
    raise MissingExtra("TQC, QRDQN, CrossQ or TRPO", "contrib")
else:
    from sb3_contrib import ARS, TRPO, MaskablePPO, RecurrentPPO
    from sb3_contrib import QRDQN as QRDQN  # which sb3_sparse.algorithms import from here
    from sb3_contrib import TQC as TQC
    from sb3_contrib import CrossQ as CrossQ
    from sb3_contrib.common.torch_layers import BatchRenorm1d
    from sb3_contrib.crossq.policies import Actor as CrossQActor
    from sb3_contrib.crossq.policies import CrossQCritic, CrossQPolicy
    from sb3_contrib.qrdqn.policies import QRDQNPolicy, QuantileNetwork
    from sb3_contrib.tqc.policies import Actor as TQCActor
    from sb3_contrib.tqc.policies import Critic, TQCPolicy


class SparseTQCActor(GaussianActor, TQCActor):
    """Actor of TQC."""


class SparseTQCCritic(SparseCritic, Critic):
    """Quantile critic of TQC."""


@register_policy(TQC, passes=sac_passes)
class SparseTQCPolicy(SparseCriticsMixin, TQCPolicy):
    """Sparse actor and quantile critics for TQC.

    Example::

        from sb3_contrib import TQC
        from sb3_sparse import SparseTQCPolicy

        model = TQC(SparseTQCPolicy, "Pendulum-v1", policy_kwargs=dict(sparsity=0.9))
    """

    acting = GAUSSIAN_ACTING
    estimate = "mean"
    actor_class = SparseTQCActor
    critic_class = SparseTQCCritic
    networks = {"actor": GAUSSIAN_ACTOR, "critic": TWIN_CRITIC}


SparseTQCMlpPolicy, SparseTQCCnnPolicy, SparseTQCMultiInputPolicy = variants_of(SparseTQCPolicy)


class SimbaTQCActor(SimbaActingModule, SparseTQCActor):
    """Actor of TQC that is a SimBa network."""


class SimbaTQCCritic(SimbaCritic, SparseTQCCritic):
    """Quantile critics of TQC that are SimBa networks."""


@register_variant(SparseTQCPolicy, "Simba")
class SparseTQCSimbaPolicy(SimbaPolicy, SparseTQCPolicy):
    """Sparse SimBa networks for TQC.

    Example::

        from sb3_contrib import TQC

        model = TQC("SparseSimbaPolicy", "Pendulum-v1", policy_kwargs=dict(sparsity=0.8))
    """

    actor_class = SimbaTQCActor
    critic_class = SimbaTQCCritic


class SparseQuantileNetwork(ActingModule, QuantileNetwork):
    """Quantile network of QR-DQN."""

    paths = (("quantile_net",),)
    n_quantiles: int
    action_space: spaces.Discrete

    def forward(self, obs: Any) -> th.Tensor:
        """As in sb3-contrib, shape ``(n, quantiles, actions)``."""
        results = self.results(obs)
        return super().forward(obs) if results is None else self._quantiles(results[0])

    def _quantiles(self, result: th.Tensor) -> th.Tensor:
        return result.view(-1, self.n_quantiles, int(self.action_space.n))

    def actions_from(self, results: list[Actions], deterministic: bool) -> Actions:
        """The actions that are best in the mean, shape ``(n,)``."""
        values = self._quantiles(th.from_numpy(results[0])).mean(dim=1)
        best: Actions = values.argmax(dim=1).numpy()
        return best


@register_policy(QRDQN, passes=value_passes("quantile_net"))
class SparseQRDQNPolicy(PredictsByModule, BaseSparsePolicy, QRDQNPolicy):
    """Sparse quantile network for QR-DQN.

    Example::

        from sb3_contrib import QRDQN
        from sb3_sparse import SparseQRDQNPolicy

        model = QRDQN(SparseQRDQNPolicy, "CartPole-v1", policy_kwargs=dict(sparsity=0.9))
    """

    acting = ("quantile_net.features_extractor", "quantile_net.quantile_net")
    acting_quantiles = "quantile_net.n_quantiles"
    estimate = "largest"
    action_spaces = (spaces.Discrete,)
    quantile_net_class: ClassVar[type[SparseQuantileNetwork]] = SparseQuantileNetwork
    quantile_net: SparseQuantileNetwork
    networks = {
        "quantile_net": NetworkSpec(
            roots=("quantile_net",),
            trunks=("quantile_net.quantile_net",),
            heads=("quantile_net.quantile_net",),
            target="quantile_net_target",
        )
    }

    def make_quantile_net(self) -> SparseQuantileNetwork:
        """As in sb3-contrib, with :attr:`quantile_net_class`."""
        kwargs = self._update_features_extractor(self.net_args, features_extractor=None)
        return self.quantile_net_class(**kwargs).to(self.device)


SparseQRDQNMlpPolicy, SparseQRDQNCnnPolicy, SparseQRDQNMultiInputPolicy = variants_of(
    SparseQRDQNPolicy
)


class SimbaQuantileNetwork(SimbaActingModule, SparseQuantileNetwork):
    """Quantile network of QR-DQN that is a SimBa network."""


@register_variant(SparseQRDQNPolicy, "Simba")
class SparseQRDQNSimbaPolicy(SimbaPolicy, SparseQRDQNPolicy):
    """Sparse SimBa network for QR-DQN.

    Example::

        from sb3_contrib import QRDQN

        model = QRDQN("SparseSimbaPolicy", "CartPole-v1", policy_kwargs=dict(sparsity=0.8))
    """

    default_arch = [256, 256]
    quantile_net_class = SimbaQuantileNetwork


class SoundBatchRenorm1d(BatchRenorm1d):
    """BatchRenorm that passes no NaN back to a unit that is constant over the batch.

    After its warm-up, sb3-contrib's takes the square root of the batch's variance, whose derivative
    at 0 is infinite. Units without inputs, which sparse layers have, are constant; their gradient
    is 0 here.
    """

    steps: th.Tensor

    def forward(self, x: th.Tensor) -> th.Tensor:
        """As in sb3-contrib, shape ``(batch, features)``."""
        if self.training and x.requires_grad and self.steps > self.warmup_steps:
            constant = x.detach().var(dim=0) == 0
            if constant.any():
                x = x.view_as(x)
                x.register_hook(partial(_zero_where, constant))  # type: ignore[no-untyped-call]
        result: th.Tensor = super().forward(x)
        return result


NORMS.append(SoundBatchRenorm1d)


def renorms_of(module: nn.Module) -> list[SoundBatchRenorm1d]:
    """Find the BatchRenorms within a module."""
    return [inner for inner in module.modules() if isinstance(inner, SoundBatchRenorm1d)]


def _zero_where(constant: th.Tensor, grad: th.Tensor) -> th.Tensor:
    return grad.masked_fill(constant, 0.0)


class SparseCrossQActor(GaussianActor, CrossQActor):
    """Actor of CrossQ."""


class SparseCrossQCritic(SparseCritic, CrossQCritic):
    """Critic of CrossQ."""


def crossq_passes(model: Any) -> list[PassCounts]:
    """The passes of a gradient step of CrossQ."""
    share = 1 / model.policy_delay
    return [
        PassCounts("actor", 1),
        PassCounts("critic", 2, 2),  # observations and next ones in one minibatch
        PassCounts("actor", share, share),
        PassCounts("critic", share, through=share),
    ]


@register_policy(CrossQ, passes=crossq_passes)
class SparseCrossQPolicy(SparseCriticsMixin, CrossQPolicy):
    """Sparse actor and critics for CrossQ, which has no target network.

    Example::

        from sb3_contrib import CrossQ
        from sb3_sparse import SparseCrossQPolicy

        kwargs = dict(sparsity=0.9, net_arch=[64, 64])
        model = CrossQ(SparseCrossQPolicy, "Pendulum-v1", policy_kwargs=kwargs)
    """

    acting = GAUSSIAN_ACTING
    actor_class = SparseCrossQActor
    critic_class = SparseCrossQCritic
    networks = {
        "actor": GAUSSIAN_ACTOR,
        "critic": NetworkSpec(
            roots=("critic",), trunks=("critic.qf*",), heads=("critic.qf*",), owner="critic"
        ),
    }

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        for module in self.modules():
            if type(module) is BatchRenorm1d:
                become(module, SoundBatchRenorm1d)


(SparseCrossQMlpPolicy,) = variants_of(SparseCrossQPolicy, "Mlp")
reject_variant(CrossQ, "Simba")  # it normalises its layers over the batch


register_policy(TRPO, own_attribute="cg_max_steps")(SparseActorCriticPolicy)
for _algorithm in (ARS, MaskablePPO, RecurrentPPO):
    reject(_algorithm)
