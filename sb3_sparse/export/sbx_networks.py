"""The networks of SBX that SB3 has too, and how their parameters are copied."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export.flax_parameters import Tree, fill, one_of, parameters, put

POINTS = np.linspace(-8.0, 8.0, 401, dtype=np.float32)
"""Where activation functions are compared."""
ACTIVATIONS: tuple[Callable[[], nn.Module], ...] = (
    nn.ReLU, nn.Tanh, nn.ELU, nn.SELU, nn.SiLU, nn.LeakyReLU, partial(nn.GELU, approximate="tanh"),
    nn.GELU, nn.Mish, nn.Softplus, nn.Softsign, nn.Sigmoid, nn.ReLU6, nn.Hardswish, nn.Hardtanh,
    nn.Hardsigmoid, nn.LogSigmoid, nn.Identity,
)  # fmt: skip
NATURE_CNN = "sbx.common.jax_layers.NatureCNN"
SIMBA = {"sparsity": 0.0, "compute": "masked"}
"""Arguments of a policy of this package, since SB3 has no SimBa networks."""


@dataclass(frozen=True)
class Counterpart:
    """What SB3 has in place of a network of SBX.

    :param kwargs: from a policy of SBX, arguments of the policy of SB3
    :param acting: copies parameters of the network that acts, from the former to the latter
    :param training: copies those of critics and target networks
    :param policy: name of the policy
    :param fixed: further arguments
    """

    kwargs: Callable[[Any], dict[str, Any]]
    acting: Callable[[Any, Any], None]
    training: Callable[[Any, Any], None]
    policy: str = "MlpPolicy"
    fixed: dict[str, Any] = field(default_factory=dict)


def counterpart_of(policy: Any) -> Counterpart:
    """Return what SB3 has in place of the acting network of a policy of SBX.

    :raises UnsupportedError: if there is nothing
    """
    path = _path(type(policy.actor if hasattr(policy, "actor") else policy.qf))
    if path not in COUNTERPARTS:
        raise UnsupportedError(
            f"a model of SBX whose acting network is {path} cannot be exported; those with a "
            f"counterpart in SB3 are {', '.join(COUNTERPARTS)}"
        )
    extractor = policy.features_extractor_class
    if extractor is None:
        return COUNTERPARTS[path]
    if _path(extractor) != NATURE_CNN:
        raise UnsupportedError(
            f"a model of SBX with the features extractor {_path(extractor)} cannot be exported; "
            f"allowed is {NATURE_CNN}"
        )
    return replace(COUNTERPARTS[path], policy="CnnPolicy")


def _path(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


def _activation(function: Any) -> Callable[[], nn.Module]:
    """Return torch's activation that computes the same as a function of JAX."""
    values = np.asarray(function(POINTS))
    for kind in ACTIVATIONS:
        if np.allclose(values, kind()(th.from_numpy(POINTS)).numpy(), rtol=0.0, atol=1e-5):
            return kind
    names = ", ".join(getattr(kind, "__name__", "GELU") for kind in ACTIVATIONS)
    raise UnsupportedError(
        f"the activation function {function} of a model of SBX cannot be exported; those with a "
        f"counterpart in torch are {names}"
    )


def _mlp(policy: Any, critic: str = "qf") -> dict[str, Any]:
    arch = {"pi": policy.net_arch_pi, critic: getattr(policy, f"net_arch_{critic}")}
    return {
        "net_arch": {name: [int(width) for width in widths] for name, widths in arch.items()},
        "activation_fn": _activation(policy.activation_fn),
    }


def _with_critics(policy: Any) -> dict[str, Any]:
    if hasattr(policy, "n_quantiles"):  # TQC, which has two critics whatever n_critics says
        return _mlp(policy) | {"n_critics": 2, "n_quantiles": policy.n_quantiles}
    return _mlp(policy) | {"n_critics": policy.n_critics}


def _with_renorm(policy: Any) -> dict[str, Any]:
    return _with_critics(policy) | {
        "batch_norm": policy.batch_norm_actor,
        "batch_norm_momentum": 1.0 - policy.batch_norm_momentum,  # as torch counts
        "renorm_warmup_steps": policy.renorm_warmup_steps,
    }


def _on_policy(policy: Any) -> dict[str, Any]:
    if policy.features_extractor_class is not None:
        kwargs = _mlp(policy, "vf") | {"share_features_extractor": False}
        _check_relu(kwargs["activation_fn"])
        return kwargs | {"features_extractor_kwargs": {"features_dim": policy.actor.features_dim}}
    return _mlp(policy, "vf")


def _q_network(policy: Any) -> dict[str, Any]:
    return {
        "net_arch": [policy.n_units] * 2,
        "activation_fn": _activation(policy.activation_fn),
    }


def _q_network_of_images(policy: Any) -> dict[str, Any]:
    _check_relu(_activation(policy.activation_fn))
    return {"net_arch": [], "features_extractor_kwargs": {"features_dim": policy.n_units}}


def _check_relu(activation: Callable[[], nn.Module]) -> None:
    if activation is not nn.ReLU:
        raise UnsupportedError(
            "a CnnPolicy of SBX can only be exported with activation_fn=flax.linen.relu, since "
            "SB3's NatureCNN has no other"
        )


def _act_gaussian(source: Any, target: Any) -> None:
    actor, state = target.actor, source.actor_state
    statistics = getattr(state, "batch_stats", None)
    fill([actor.latent_pi, actor.mu, actor.log_std], parameters(state.params), statistics)


def _act_deterministic(source: Any, target: Any) -> None:
    fill([target.actor.mu], parameters(source.actor_state.params))


def _train_deterministic(source: Any, target: Any) -> None:
    fill([target.actor_target.mu], parameters(source.actor_state.target_params))
    _train_critics(source, target)


def _train_critics(source: Any, target: Any) -> None:
    if source.layer_norm or source.dropout_rate:
        raise UnsupportedError(
            "critics with layer_norm or dropout_rate have no counterpart in SB3, so the model "
            "cannot train there; export to c, numpy or onnx instead, which need no critic without "
            "with_value (--with-value)"
        )
    for networks, kind in ((target.critic, "params"), (target.critic_target, "target_params")):
        for network, tree in zip(networks.q_networks, _critics(source, kind), strict=True):
            fill([network], tree)


def _train_normalised_critics(source: Any, target: Any) -> None:
    trees, statistics = (_critics(source, kind) for kind in ("params", "batch_stats"))
    for network, *both in zip(target.critic.q_networks, trees, statistics, strict=True):
        fill([network], *both)


def _critics(source: Any, kind: str) -> list[Tree]:
    """Return what each critic has of a kind: in TQC a state each, else stacked in one."""
    if not hasattr(source, "qf_state"):
        return [parameters(getattr(one, kind)) for one in (source.qf1_state, source.qf2_state)]
    (stacked,) = parameters(getattr(source.qf_state, kind)).values()
    return [one_of(stacked, number) for number in range(source.n_critics)]


def _act_on_policy(source: Any, target: Any) -> None:
    tree = dict(parameters(source.actor_state.params))
    deviations = tree.pop("log_std", None)
    extractor, layers = target.pi_features_extractor, target.mlp_extractor.policy_net
    fill([extractor, layers, target.action_net], tree)
    if deviations is not None:
        put(target.log_std, deviations, "log_std")


def _train_on_policy(source: Any, target: Any) -> None:
    extractor, layers = target.vf_features_extractor, target.mlp_extractor.value_net
    fill([extractor, layers, target.value_net], parameters(source.vf_state.params))


def _act_by_q(source: Any, target: Any) -> None:
    network = target.q_net
    fill([network.features_extractor, network.q_net], parameters(source.qf_state.params))


def _train_q(source: Any, target: Any) -> None:
    network = target.q_net_target
    fill([network.features_extractor, network.q_net], parameters(source.qf_state.target_params))


COUNTERPARTS = {
    "sbx.common.policies.SquashedGaussianActor": Counterpart(
        _with_critics, _act_gaussian, _train_critics
    ),
    "sbx.common.policies.SimbaSquashedGaussianActor": Counterpart(
        _with_critics, _act_gaussian, _train_critics, "SparseSimbaPolicy", SIMBA
    ),
    "sbx.crossq.policies.Actor": Counterpart(
        _with_renorm, _act_gaussian, _train_normalised_critics
    ),
    "sbx.td3.policies.Actor": Counterpart(_with_critics, _act_deterministic, _train_deterministic),
    "sbx.ppo.policies.Actor": Counterpart(_on_policy, _act_on_policy, _train_on_policy),
    "sbx.dqn.policies.QNetwork": Counterpart(_q_network, _act_by_q, _train_q),
    "sbx.dqn.policies.CnnQNetwork": Counterpart(
        _q_network_of_images, _act_by_q, _train_q, "CnnPolicy"
    ),
}
"""By the class of the network that acts."""
