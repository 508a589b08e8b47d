"""The algorithms that have a sparse policy.

Their names are known without torch. The modules that register them are imported when a class is
asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, TypeVar

from sb3_sparse.errors import ConfigError, UnsupportedError

if TYPE_CHECKING:  # imported when an algorithm is, not when one is named
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import BasePolicy
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

    from sb3_sparse.policies.base import BaseSparsePolicy
    from sb3_sparse.policies.spec import PassCounts

    CountPasses = Callable[[Any], list[PassCounts]]

SparsePolicy = "SparsePolicy"
"""The sparse policy of whichever algorithm it is passed to."""
SparseSimbaPolicy = "SparseSimbaPolicy"
"""The sparse policy of SimBa networks, of whichever algorithm it is passed to."""
SB3 = {
    "DQN": "dqn",
    "SAC": "sac",
    "TD3": "td3",
    "DDPG": "td3",
    "PPO": "actor_critic",
    "A2C": "actor_critic",
}
"""Algorithms of Stable-Baselines3, and the module of this package that registers each."""
CONTRIB = ("TQC", "QRDQN", "CrossQ", "TRPO")
"""Algorithms of sb3-contrib; the module ``contrib`` registers them."""
Policy = TypeVar("Policy", bound="BaseSparsePolicy")


@dataclass(frozen=True)
class Registration:
    """An algorithm and its sparse policy; the fields are arguments of :func:`register_policy`."""

    algorithm: type[BaseAlgorithm]
    policy: type[BaseSparsePolicy]
    passes: CountPasses | None
    own_attribute: str

    @property
    def stock_policy(self) -> type[BasePolicy]:
        """The policy class that :attr:`policy` makes sparse."""
        from stable_baselines3.common.policies import BasePolicy

        from sb3_sparse.policies.training_mode import FastModeSwitch

        return next(
            cls
            for cls in self.policy.__mro__
            if issubclass(cls, BasePolicy) and not issubclass(cls, FastModeSwitch)
        )


_registered: dict[str, Registration] = {}
_variants: dict[type[BaseSparsePolicy], dict[str, type[BaseSparsePolicy]]] = {}
_rejected: list[type[BaseAlgorithm]] = []


def register_policy(
    algorithm: type[BaseAlgorithm], *, passes: CountPasses | None = None, own_attribute: str = ""
) -> Callable[[type[Policy]], type[Policy]]:
    """Class decorator that makes a class the sparse policy of an algorithm.

    The algorithm then takes ``"SparsePolicy"``, and every command knows its lower-case name. ::

        @register_policy(MySAC)
        class MySACPolicy(SparseSACPolicy): ...

    :param algorithm: class of the algorithm
    :param passes: function of a model that counts the passes of one gradient step, for
        :func:`sb3_sparse.analysis.flops`; not needed if the algorithm inherits ``train()`` from a
        registered one
    :param own_attribute: attribute that, of the algorithms with this policy class, only this one's
        models have; it tells which algorithm saved a zip
    :raises ConfigError: if another algorithm has that name already
    """

    def register(policy: type[Policy]) -> type[Policy]:
        name = algorithm.__name__
        for known, one in _registered.items():
            if known.lower() == name.lower() and _address(one.algorithm) != _address(algorithm):
                raise ConfigError(
                    f"the algorithm name {known!r} is taken by {_address(one.algorithm)}; give "
                    f"{_address(algorithm)} another"
                )
        _registered[name] = Registration(algorithm, policy, passes, own_attribute)
        if "policy_aliases" not in vars(algorithm):  # or it would change its base class's
            stock = {
                n: c for n, c in algorithm.policy_aliases.items() if not n.startswith("Sparse")
            }
            algorithm.policy_aliases = stock
        _add_aliases(algorithm, {"": policy, **_variants.get(policy, {})})
        return policy

    return register


def variants_of(policy: type[Policy], *prefixes: str) -> list[type[Policy]]:
    """Subclasses of a sparse policy with SB3's features extractors by default.

    The algorithms that the policy is registered for know them as ``"Sparse<prefix>Policy"``. The
    policy's module must bind each to its own name, e.g. ``SparseSACMlpPolicy``, for pickle.

    :param policy: a registered policy class
    :param prefixes: some of ``"Mlp"``, ``"Cnn"`` and ``"MultiInput"``; none: all of these
    """
    from stable_baselines3.common import torch_layers

    extractors: dict[str, type[BaseFeaturesExtractor]] = {
        "Mlp": torch_layers.FlattenExtractor,
        "Cnn": torch_layers.NatureCNN,
        "MultiInput": torch_layers.CombinedExtractor,
    }
    found = {}
    for prefix in prefixes or extractors:
        extractor = extractors[prefix]
        members = {
            "__module__": policy.__module__,
            "__doc__": f"{policy.__name__} with {extractor.__name__} by default.",
            "extractor_class": extractor,
        }
        name = policy.__name__.removesuffix("Policy") + prefix + "Policy"
        found[prefix] = type(name, (policy,), members)
    _add_variants(policy, found)
    return list(found.values())


def register_variant(policy: type[Policy], prefix: str) -> Callable[[type[Policy]], type[Policy]]:
    """Class decorator that registers a subclass of a sparse policy as ``Sparse<prefix>Policy``.

    :param policy: a registered policy class
    :param prefix: e.g. ``"Simba"``
    """

    def register(variant: type[Policy]) -> type[Policy]:
        _add_variants(policy, {prefix: variant})
        return variant

    return register


def _add_variants(policy: type[Any], variants: Mapping[str, type[Any]]) -> None:
    _variants.setdefault(policy, {}).update(variants)
    for one in _registered.values():
        if one.policy is policy:
            _add_aliases(one.algorithm, variants)


def _add_aliases(algorithm: type[BaseAlgorithm], policies: Mapping[str, Any]) -> None:
    for prefix, policy in policies.items():
        algorithm.policy_aliases[f"Sparse{prefix}Policy"] = policy


def reject(algorithm: type[BaseAlgorithm]) -> None:
    """Let ``"SparsePolicy"`` raise an error in an algorithm that has no sparse policy."""

    def no_policy(*args: Any, **kwargs: Any) -> Any:
        raise UnsupportedError(
            f"{algorithm.__name__} has no sparse policy; supported are {', '.join(registered())}"
        )

    _add_aliases(algorithm, dict.fromkeys(("", "Mlp", "Cnn", "MultiInput"), no_policy))
    _rejected.append(algorithm)


def reject_variant(algorithm: type[BaseAlgorithm], prefix: str) -> None:
    """Let ``"Sparse<prefix>Policy"`` raise an error in an algorithm that has no such policy."""

    def no_policy(*args: Any, **kwargs: Any) -> Any:
        raise UnsupportedError(_absence(algorithm, f"Sparse{prefix}Policy"))

    _add_aliases(algorithm, {prefix: no_policy})


def _address(cls: type) -> str:
    """Where a class is defined; the same when its cell or module is run again."""
    return f"{cls.__module__}.{cls.__qualname__}"


def algorithm_names() -> list[str]:
    """Class names of all algorithms with a sparse policy that are installed or registered."""
    shipped = [*SB3, *(CONTRIB if find_spec("sb3_contrib") else ())]
    return list(dict.fromkeys([*shipped, *_registered]))


def registered() -> dict[str, Registration]:
    """Every registration by the algorithm's class name, those of users last."""
    names = algorithm_names()
    for name in names:
        if name not in _registered:
            import_module(f"sb3_sparse.policies.{SB3.get(name, 'contrib')}")
    return {name: _registered[name] for name in names}


def supported_algorithms() -> dict[str, type[BaseAlgorithm]]:
    """The algorithms that a sparse policy is registered for, by class name."""
    return {name: one.algorithm for name, one in registered().items()}


def policy_named(algorithm: type[BaseAlgorithm], alias: str) -> type[BaseSparsePolicy]:
    """The sparse policy of an algorithm.

    :param alias: e.g. ``"SparseSimbaPolicy"``
    :raises ConfigError: naming the algorithms that have it, if this one does not
    """
    policy: Any = algorithm.policy_aliases.get(alias)
    if not isinstance(policy, type):
        raise ConfigError(_absence(algorithm, alias))
    return policy


def _absence(algorithm: type[BaseAlgorithm], alias: str) -> str:
    able = (
        name
        for name, one in supported_algorithms().items()
        if isinstance(one.policy_aliases.get(alias), type)
    )
    return f"{algorithm.__name__} has no {alias}; it is there for {', '.join(able)}"


def lineage(algo: str) -> list[str]:
    """Lower-case names of an algorithm and of the classes that it inherits from.

    :param algo: lower-case name
    """
    for name, one in registered().items():
        if name.lower() == algo:
            return [cls.__name__.lower() for cls in one.algorithm.__mro__]
    return [algo]


def sparse_counterpart(policy: BasePolicy) -> type[BaseSparsePolicy] | None:
    """The class that declares where a policy keeps its networks; None: there is none.

    :param policy: sparse, which is its own counterpart, or stock
    """
    from sb3_sparse.policies.base import BaseSparsePolicy

    if isinstance(policy, BaseSparsePolicy):
        return type(policy)
    known = registered().values()
    for cls in type(policy).__mro__:
        for one in known:
            if cls is one.stock_policy:
                return one.policy
    return None


def possible_algorithms(policy: type, attributes: Container[str] | None = None) -> list[str]:
    """Class names of the algorithms that may have saved a model, the likeliest first.

    :param policy: class of the model's policy
    :param attributes: names of the model's attributes; None: not known
    """
    known = registered()
    for cls in policy.__mro__:
        if any(cls in algorithm.policy_aliases.values() for algorithm in _rejected):
            break
        same = [n for n, one in known.items() if cls in one.algorithm.policy_aliases.values()]
        if same:
            if attributes is None:
                return same
            told = [name for name in same if known[name].own_attribute in attributes]
            return told or [name for name in same if not known[name].own_attribute]
    return []
