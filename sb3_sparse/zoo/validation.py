"""Checks the settings of a run before anything is trained."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Set
from dataclasses import fields
from itertools import chain
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_sparse import callbacks
from sb3_sparse.callback import SparsityCallback
from sb3_sparse.engine.optimizers import check_weight_decay
from sb3_sparse.errors import ConfigError, did_you_mean
from sb3_sparse.policies.arguments import arguments_of, import_classes
from sb3_sparse.policies.config import SPARSITY_MISSING, SparsityConfig
from sb3_sparse.topology import Methods
from sb3_sparse.zoo.arguments import kind_of
from sb3_sparse.zoo.buffers import import_buffers
from sb3_sparse.zoo.callbacks import CALLBACK, ROBUST_VALUE, package_callbacks
from sb3_sparse.zoo.names import SET_BY_THE_RUN, Names
from sb3_sparse.zoo.settings import Settings

OF_SPARSITY = frozenset(one.name for one in fields(SparsityConfig))


def check_settings(settings: Settings, algorithm: type[BaseAlgorithm]) -> None:
    """Reject settings that cannot be trained as they are.

    :raises ConfigError: for an unknown key, a value that is not allowed, or a sparsity
        that training would not reach
    """
    kwargs, callback = settings.policy_kwargs, settings.callback
    names = Names.of(algorithm, settings.alias)
    algo = algorithm.__name__
    _check_keys(settings, names.algorithm, f"{algo} and rl-zoo have no setting", names)
    _check_keys(kwargs, names.policy, f"policy_kwargs of {algo} have no", names)
    if callback is not None and not settings.has_own_callback:
        allowed = names.schedule | {"method", "verbose"}
        _check_keys(callback, allowed, f"{CALLBACK} has no argument", names)
    named = package_callbacks(settings)
    ours = [(path, getattr(callbacks, name), given) for path, name, given in named]
    for path, kind, given in ours:
        _check_keys(given, arguments_of(kind), f"{path} has no argument", names)
        for name, value in given.items():
            _check_no_text_for_a_number(name, value)
    parts = (settings, kwargs, callback, kwargs.get("optimizer_kwargs"))
    for name, value in chain.from_iterable((part or {}).items() for part in parts):
        _check_value(algo.lower(), name, value)
    import_classes(dict(kwargs))
    import_buffers(dict(settings))
    if settings.get("noise_type") is not None and "noise_std" not in settings:
        raise ConfigError("noise_type needs noise_std, e.g. noise_std: 0.1")
    stored = issubclass(algorithm, OffPolicyAlgorithm)
    if stored and settings.get("normalize") and settings.get("frame_stack"):
        raise ConfigError(
            f"normalize and frame_stack cannot be combined in {algo}: Stable-Baselines3 stores "
            "observations as they are before either; drop one"
        )
    if "sparsity" not in kwargs:
        raise ConfigError(SPARSITY_MISSING)
    networks = settings.policy_class(algorithm).networks
    config = SparsityConfig(**{n: value for n, value in kwargs.items() if n in OF_SPARSITY})
    config.check_names(networks)
    check_weight_decay(kwargs.get("weight_decay", 0.0), kwargs.get("optimizer_kwargs"))
    if callback is not None and not settings.has_own_callback:
        SparsityCallback(**callback).plans.check(networks)
    for _, kind, given in ours:
        kind(**given)
    _check_start(kwargs, settings.methods, networks)


def _check_keys(given: Mapping[str, Any], allowed: Set[str], what: str, names: Names) -> None:
    for name in given:
        if name in allowed:
            continue
        if name in names.policy:
            cure = "; it is the policy's: put it under policy_kwargs"
        elif name in names.schedule:
            cure = f"; it is the mask's schedule's: put it under {CALLBACK}"
        elif name in names.robust_value:
            cure = f"; put it under sb3_sparse.{ROBUST_VALUE}"
        elif name in names.algorithm:
            cure = "; it is the algorithm's: put it beside policy_kwargs"
        elif name in SET_BY_THE_RUN:
            cure = "; it has its own option"
        else:
            cure = did_you_mean(name, allowed)
        raise ConfigError(f"{what} {name!r}{cure}. Allowed are {', '.join(sorted(allowed))}")


def _check_value(algo: str, name: str, value: Any) -> None:
    _check_no_text_for_a_number(name, value)
    kind = kind_of(algo, name)
    if kind is not None and not kind.fits(value):
        raise ConfigError(f"{name} must be {kind.allowed}; got {value!r}")


def _check_no_text_for_a_number(name: str, value: Any) -> None:
    if isinstance(value, str) and _is_number(value):
        raise ConfigError(
            f"{name} is the text {value!r}, as YAML reads a number without a dot and a sign; write "
            f"{name}: !!float {value}"
        )


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _check_start(
    kwargs: Mapping[str, Any], methods: Methods | None, networks: Iterable[str]
) -> None:
    """Require a method that prunes for a denser start, and a denser start for such a method.

    :param networks: names of the policy's networks
    """
    final, initial = kwargs["sparsity"], kwargs.get("initial_sparsity")
    ends, starts = _by_network(final, networks), _by_network(initial, networks)
    denser = {n for n, start in starts.items() if start is not None and start < ends[n]}
    prunes = {n for n in networks if methods is not None and methods[n].reaches_final}
    if denser - prunes:
        how = "without a callback" if methods is None else f"with method {methods.label!r}"
        raise ConfigError(
            f"initial_sparsity: {initial} begins denser than sparsity: {final}, and {how} training "
            f"would keep {', '.join(sorted(denser - prunes))} that dense; leave initial_sparsity "
            f"out there, or prune with callback: [{{{CALLBACK}: {{method: prune}}}}]"
        )
    idle = {network for network in prunes - denser if ends[network] != 0.0}
    if idle or (prunes and not denser):
        assert methods is not None
        usual = methods.initial_sparsity(final)
        where = f" for {', '.join(sorted(idle))}" if idle and denser else ""
        raise ConfigError(
            f"method {methods.label!r} begins denser than it ends, but initial_sparsity is "
            f"{initial} and sparsity {final}{where}; give initial_sparsity: {usual} and a sparsity "
            "above 0"
        )


def _by_network(value: Any, networks: Iterable[str]) -> dict[str, Any]:
    """Return the value for each network, of one value for all or of values by name."""
    named = value if isinstance(value, Mapping) else dict.fromkeys(networks, value)
    return {network: named.get(network) for network in networks}
