"""Builds the dense network with as many parameters as a sparse one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space

from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.internals import no_schedule
from sb3_sparse.sparsity.widths import equivalent_widths
from sb3_sparse.zoo.settings import Settings

EXTRACTOR = "features_extractor_class"
EXTRACTOR_KWARGS = "features_extractor_kwargs"
OF_EXTRACTOR = ("channels", "features_dim")


@dataclass(frozen=True)
class Match:
    """A dense network that matches the parameter count of a sparse one.

    :param sparsity: sparsity of the network that was matched
    :param target: its parameter count: active connections and biases
    :param achieved: parameters of the dense network
    :param policy_kwargs: the policy's arguments with the scaled widths
    """

    sparsity: float
    target: int
    achieved: int
    policy_kwargs: dict[str, Any]

    def __str__(self) -> str:
        widths = {"net_arch": self.policy_kwargs["net_arch"]}
        extractor = self.policy_kwargs.get(EXTRACTOR_KWARGS, {})
        widths.update({name: extractor[name] for name in OF_EXTRACTOR if name in extractor})
        built = ", ".join(f"{name} {width}" for name, width in widths.items())
        return (
            f"Built a dense network of {built}: {self.achieved:,} parameters; at "
            f"{self.sparsity:.4g} sparsity the full one has {self.target:,}"
        )


def match_parameters(
    algorithm: type[BaseAlgorithm],
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    settings: Settings,
    sparsity: float,
) -> Match:
    """Scale all hidden widths (channels and dense units of an image network too) by one factor.

    :param settings: settings of the dense network at full width
    :param sparsity: sparsity of the network to match, in [0, 1)
    :raises ConfigError: if the settings do not give the network's widths
    """
    kwargs = _with_widths(settings.policy_kwargs, observation_space)
    hidden = [int(container[key]) for container, key in _places(kwargs)]

    def parameters(changed: dict[str, Any]) -> int:
        policy = untrained_policy(
            algorithm, observation_space, action_space, settings.replaced(policy_kwargs=changed)
        )
        return policy.sparsity_report().parameters

    def scaled(widths: list[int]) -> dict[str, Any]:
        changed = deepcopy(kwargs)
        for (container, key), width in zip(_places(changed), widths, strict=True):
            container[key] = width
        return changed

    target = parameters({**kwargs, "sparsity": sparsity})
    widths, achieved = equivalent_widths(hidden, lambda w: parameters(scaled(w)), target)
    return Match(sparsity, target, achieved, scaled(widths))


def untrained_policy(
    algorithm: type[BaseAlgorithm],
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    settings: Settings,
) -> BaseSparsePolicy:
    """Make the policy that the algorithm would make from these settings."""
    kwargs = settings.policy_kwargs
    if settings.get("use_sde"):
        kwargs["use_sde"] = True
    policy_class: Any = settings.policy_class(algorithm)
    policy: BaseSparsePolicy = policy_class(observation_space, action_space, no_schedule, **kwargs)
    return policy


def _with_widths(policy_kwargs: Mapping[str, Any], space: spaces.Space[Any]) -> dict[str, Any]:
    """Return the arguments with every width written out."""
    kwargs = deepcopy(dict(policy_kwargs))
    if "net_arch" not in kwargs:
        raise ConfigError(
            "matching parameters needs the widths of the network; give them, e.g. --hyperparams "
            "net_arch:[256,256]"
        )
    if is_image_space(space):
        kwargs.setdefault(EXTRACTOR, "sb3_sparse.networks.ScaledNatureCNN")
        given = kwargs.get(EXTRACTOR_KWARGS, {})
        kwargs[EXTRACTOR_KWARGS] = {"channels": [32, 64, 64], "features_dim": 512, **given}
    return kwargs


def _places(kwargs: dict[str, Any]) -> Iterator[tuple[Any, Any]]:
    """Yield the place of each hidden width: those of net_arch, then those of an image network.

    :return: pairs of a list and an index, or of a mapping and a name
    """
    arch = kwargs["net_arch"]
    extractor = kwargs.get(EXTRACTOR_KWARGS, {})
    lists = list(arch.values()) if isinstance(arch, dict) else [arch]
    for widths in [*lists, extractor.get("channels", [])]:
        yield from ((widths, index) for index in range(len(widths)))
    if "features_dim" in extractor:
        yield extractor, "features_dim"
