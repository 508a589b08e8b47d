"""The plan of each network: one for all, or one by name."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from sb3_sparse.engine.plan import Plan
from sb3_sparse.errors import ConfigError
from sb3_sparse.topology import Methods


@dataclass(frozen=True)
class Plans:
    """When masks move, and how, in each network.

    :param usual: plan of every network that is not named
    :param named: plans by network
    """

    usual: Plan
    named: Mapping[str, Plan] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        method: str | Mapping[str, str],
        options: Mapping[str, Any],
        defaults: Mapping[str, Any],
    ) -> Plans:
        """Make plans of a method and options, each of which is for all networks or by network.

        :param method: as in :meth:`sb3_sparse.topology.Methods.of`
        :param options: value by option
        :param defaults: the values that options have if none is given; None as ``begin`` stands for
            the method's own
        :raises ConfigError: for a value that is not allowed, or an option that means nothing for
            the method of a network that it is given for, or for any method
        """
        methods = Methods.of(method)
        by_network = {name: v for name, v in options.items() if isinstance(v, Mapping)}
        for_all = {name: v for name, v in options.items() if name not in by_network}
        given = {name for name, value in for_all.items() if value != defaults[name]}
        _check_options(f"method {methods.label!r}", given, methods.options)
        networks = dict.fromkeys([*methods.named, *(n for v in by_network.values() for n in v)])
        named = {}
        for network in networks:
            own = {name: v[network] for name, v in by_network.items() if network in v}
            where = f"method {methods[network].name!r} of {network!r}"
            if methods.named and network not in methods.named and not methods[network].options:
                known = ", ".join(map(repr, methods.named))
                where = f"{network!r} is not among {known}, so its {where}"
            _check_options(where, set(own), methods[network].options)
            try:
                named[network] = _plan(methods, network, {**defaults, **for_all, **own})
            except ConfigError as error:
                raise ConfigError(f"{network}: {error}") from error
        return cls(_plan(methods, "", {**defaults, **for_all}), named)

    def __getitem__(self, network: str) -> Plan:
        return self.named.get(network, self.usual)

    def check(self, networks: Collection[str]) -> None:
        """Check that all plans are for networks of a policy.

        :param networks: names of the policy's networks
        :raises ConfigError: if a plan is for another one
        """
        unknown = [repr(name) for name in self.named if name not in networks]
        if unknown:
            raise ConfigError(
                f"the policy has no network {', '.join(unknown)}; its networks are "
                f"{', '.join(map(repr, networks))}"
            )


def _check_options(what: str, given: Collection[str], allowed: frozenset[str]) -> None:
    unused = sorted(set(given) - allowed)
    if unused:
        raise ConfigError(
            f"{what} has no {', '.join(unused)}; it takes "
            f"{', '.join(sorted(allowed)) or 'no options'}"
        )


def _plan(methods: Methods, network: str, options: Mapping[str, Any]) -> Plan:
    method = methods[network]
    begin = method.default_begin if options["begin"] is None else options["begin"]
    return Plan(method.name, **{**options, "begin": begin})
