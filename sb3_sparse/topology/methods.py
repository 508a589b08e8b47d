"""The topology method of each network of a policy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sb3_sparse.errors import ConfigError
from sb3_sparse.sparsity.numeric import is_number
from sb3_sparse.topology.base import TopologyMethod
from sb3_sparse.topology.registry import method_named

STATIC = "static"


@dataclass(frozen=True, eq=False)
class Methods:
    """One method for all networks of a policy, or one for each. They are equal if labels are.

    Example::

        from sb3_sparse.topology import Methods

        methods = Methods.of({"critic": "rigl"})
        print(methods.label, methods["critic"].name, methods["actor"].name)  # the actor is static

    :param usual: name of the method of every network that is not named
    :param named: names of methods by network
    :raises ConfigError: for an unknown method, or a network that is not a text
    """

    usual: str
    named: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for network in self.named:
            if not isinstance(network, str):
                raise ConfigError(
                    f'a method is given for {network!r}; networks have names, e.g. "critic"'
                )
        for name in (self.usual, *self.named.values()):
            method_named(name)

    @classmethod
    def of(cls, given: str | Mapping[str, str]) -> Methods:
        """Make it of a method's name, or of names by network; a network left out is static.

        :raises ConfigError: for an unknown method or an empty mapping
        """
        if not isinstance(given, Mapping):
            return cls(given)
        if not given:
            raise ConfigError(
                "no network has a method; name at least one, e.g. "
                '{"actor": "static", "critic": "rigl"}, or give one method for all'
            )
        return cls(STATIC, dict(given))

    @classmethod
    def parse(cls, text: str) -> Methods:
        """Make it of a text as :attr:`label` writes it: ``"rigl"``, ``"critic=rigl"``.

        :raises ConfigError: for an unknown method, or for a network without one or with two
        """
        if "=" not in text:
            return cls.of(text)
        named: dict[str, str] = {}
        for part in text.split(","):
            network, equals, method = (word.strip() for word in part.partition("="))
            if not (network and equals and method) or network in named:
                raise ConfigError(
                    "methods by network are given as network=method, each network once, e.g. "
                    f"actor=set,critic=rigl; got {text!r}"
                )
            named[network] = method
        return cls.of(named)

    def __getitem__(self, network: str) -> TopologyMethod:
        return method_named(self.named.get(network, self.usual))

    @property
    def label(self) -> str:
        """The method's name, or the methods by network in alphabetical order.

        Networks that have the usual method are left out, as ``Methods.of`` takes them.
        """
        named = sorted(item for item in self.named.items() if item[1] != self.usual)
        return ", ".join(f"{network}={name}" for network, name in named) or self.usual

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Methods) and self.label == other.label

    def __hash__(self) -> int:
        return hash(self.label)

    @property
    def options(self) -> frozenset[str]:
        """Arguments of the callback that any of the methods uses."""
        names = (self.usual, *self.named.values())
        return frozenset().union(*(method_named(name).options for name in names))

    @property
    def moving(self) -> tuple[str, ...]:
        """The methods that may move masks, in the order of their networks' names."""
        names = [name for _, name in sorted(self.named.items())] or [self.usual]
        return tuple(name for name in names if method_named(name).options)

    @property
    def start_dense(self) -> bool:
        """Whether all networks usually start dense."""
        names = self.named.values() or [self.usual]
        return all(method_named(name).initial_sparsity(1.0) == 0.0 for name in names)

    def initial_sparsity(self, sparsity: Any) -> float | dict[str, float] | None:
        """Return the sparsity that training usually starts with; None: the one that it ends with.

        :param sparsity: sparsity at the end, of all networks or by network; values that are no
            numbers are left out
        """
        shares = sparsity if isinstance(sparsity, Mapping) else dict.fromkeys(self.named, sparsity)
        if not shares:
            method = method_named(self.usual)
            prunes = method.reaches_final and is_number(sparsity)
            return method.initial_sparsity(sparsity) if prunes else None
        found = {
            network: self[network].initial_sparsity(share)
            for network, share in shares.items()
            if self[network].reaches_final and is_number(share)
        }
        return found or None
