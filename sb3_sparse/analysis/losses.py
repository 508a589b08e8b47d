"""The losses of algorithms, computed one sample at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from torch.nn import functional as F

from sb3_sparse.algorithms.table import nearest
from sb3_sparse.engine.internals import pytree
from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.internals import progress_remaining

Samples = dict[str, Any]
MakeLosses = Callable[[Any, Any, Any], "list[Loss]"]


@dataclass(frozen=True)
class Loss:
    """One loss that an algorithm minimises; its mean over the minibatch is the algorithm's own.

    Example::

        from sb3_sparse.analysis import Loss

        def squared_error(policy, sample):
            return (policy.q_net(sample["observations"][None]) - sample["target"]).square().mean()

        def losses(model, policy, batch):  # for register_losses
            samples = dict(observations=batch.observations, target=batch.rewards)
            return [Loss(("q_net",), samples, squared_error)]

    :param networks: names of the networks that it trains
    :param samples: tensors, or dicts of tensors, whose first dimension is the sample
    :param of_sample: computes the loss of a policy for one sample, without that dimension
    """

    networks: tuple[str, ...]
    samples: Samples
    of_sample: Callable[[Any, Samples], th.Tensor]


_losses: dict[type[Any], MakeLosses] = {}


def register_losses(algorithm: type[BaseAlgorithm]) -> Callable[[MakeLosses], MakeLosses]:
    """Decorator of a function that makes an algorithm's losses, for ``gradient_snr``.

    It takes a model, a twin of its policy with dense weights, and a minibatch.

    :param algorithm: class of the algorithm; its subclasses with the same ``train()`` have the same
        losses, unless others are registered for them
    """

    def register(losses: MakeLosses) -> MakeLosses:
        _losses[algorithm] = losses
        return losses

    return register


def _one(observation: Any) -> Any:
    """A batch of one sample."""
    return pytree.tree_map(lambda part: part.unsqueeze(0), observation)


def _discounts(model: Any, batch: Any) -> Any:
    discounts = getattr(batch, "discounts", None)  # of n-step returns
    return model.gamma if discounts is None else discounts


@register_losses(DQN)
def _dqn(model: Any, policy: Any, batch: Any) -> list[Loss]:
    following = policy.q_net_target(batch.next_observations).max(dim=1).values.reshape(-1, 1)
    target = batch.rewards + (1 - batch.dones) * _discounts(model, batch) * following

    def of_sample(policy: Any, sample: Samples) -> th.Tensor:
        values = policy.q_net(_one(sample["observations"]))
        chosen = th.gather(values, 1, sample["actions"].reshape(1, 1))
        loss: th.Tensor = F.smooth_l1_loss(chosen, sample["target"].reshape(1, 1))
        return loss

    samples = dict(observations=batch.observations, actions=batch.actions.long(), target=target)
    return [Loss(("q_net",), samples, of_sample)]


def _squashed(actor: Any, observations: Any, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """SAC's action and its log probability, shapes ``(n, dim)`` and ``(n, 1)``, for given noise."""
    mean, log_std, _ = actor.get_action_dist_params(observations)
    action: th.Tensor = th.tanh(mean + log_std.exp() * noise)
    gaussian = -0.5 * noise**2 - log_std - 0.5 * th.log(th.tensor(2 * th.pi))
    correction = th.log(1 - action**2 + actor.action_dist.epsilon)
    return action, (gaussian - correction).sum(dim=1, keepdim=True)


@register_losses(SAC)
def _sac(model: Any, policy: Any, batch: Any) -> list[Loss]:
    if model.use_sde:
        raise ConfigError("gradient_snr does not cover SAC with use_sde=True")
    log_coef = model.log_ent_coef
    coef = model.ent_coef_tensor if log_coef is None else log_coef.detach().exp()
    noise, next_noise = th.randn_like(batch.actions), th.randn_like(batch.actions)
    actions, log_prob = _squashed(policy.actor, batch.next_observations, next_noise)
    values = th.cat(policy.critic_target(batch.next_observations, actions), dim=1)
    following = values.min(dim=1, keepdim=True).values - coef * log_prob
    target = batch.rewards + (1 - batch.dones) * _discounts(model, batch) * following

    def actor(policy: Any, sample: Samples) -> th.Tensor:
        observation = _one(sample["observations"])
        action, log_prob = _squashed(policy.actor, observation, _one(sample["noise"]))
        values = th.cat(policy.critic(observation, action), dim=1)
        loss: th.Tensor = sample["coef"] * log_prob - values.min(dim=1, keepdim=True).values
        return loss.sum()

    def critic(policy: Any, sample: Samples) -> th.Tensor:
        values = policy.critic(_one(sample["observations"]), _one(sample["actions"]))
        errors = th.cat(values, dim=1) - sample["target"]
        loss: th.Tensor = 0.5 * errors.square().sum()
        return loss

    coefs = coef.reshape(1).expand(len(noise))
    observations = batch.observations
    return [
        Loss(("actor",), dict(observations=observations, noise=noise, coef=coefs), actor),
        Loss(
            ("critic",),
            dict(observations=observations, actions=batch.actions, target=target),
            critic,
        ),
    ]


@register_losses(PPO)
def _ppo(model: Any, policy: Any, batch: Any) -> list[Loss]:
    progress = progress_remaining(model)
    clip = model.clip_range(progress)
    clip_vf = None if model.clip_range_vf is None else model.clip_range_vf(progress)
    advantages = batch.advantages
    if model.normalize_advantage and len(advantages) > 1:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    actions = batch.actions
    if isinstance(model.action_space, spaces.Discrete):
        actions = actions.long().flatten()

    def of_sample(policy: Any, sample: Samples) -> th.Tensor:
        observation, action = _one(sample["observations"]), sample["actions"].unsqueeze(0)
        values, log_prob, entropy = policy.evaluate_actions(observation, action)
        advantage, value = sample["advantages"], values.flatten()
        ratio = th.exp(log_prob - sample["old_log_prob"])
        gain = th.min(advantage * ratio, advantage * th.clamp(ratio, 1 - clip, 1 + clip))
        if clip_vf is not None:
            old = sample["old_values"]
            value = old + th.clamp(value - old, -clip_vf, clip_vf)
        error = F.mse_loss(sample["returns"].reshape(1), value)
        surprise = log_prob if entropy is None else -entropy
        loss: th.Tensor = -gain.sum() + model.ent_coef * surprise.sum() + model.vf_coef * error
        return loss

    samples = dict(
        observations=batch.observations,
        actions=actions,
        advantages=advantages,
        old_log_prob=batch.old_log_prob,
        old_values=batch.old_values,
        returns=batch.returns,
    )
    return [Loss(("actor", "critic"), samples, of_sample)]


def losses_for(algorithm: type[BaseAlgorithm]) -> MakeLosses:
    """The function that :func:`register_losses` was given for an algorithm.

    :raises ConfigError: for an algorithm whose ``train()`` is none of the known ones
    """
    losses = nearest(algorithm, _losses)
    if losses is None:
        raise ConfigError(
            f"gradient_snr has no loss of {algorithm.__name__}; supported are "
            f"{', '.join(known.__name__ for known in _losses)}"
        )
    return losses


@contextmanager
def unchecked_distributions() -> Iterator[None]:
    """Keep torch's distributions from checking their arguments, which vmap cannot follow."""
    distribution: Any = th.distributions.Distribution
    before = distribution._validate_args
    distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        distribution.set_default_validate_args(before)
