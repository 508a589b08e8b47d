"""Checks the settings of a run before anything is trained."""

from __future__ import annotations

import math
from collections.abc import Mapping, Set
from dataclasses import fields
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_sparse.callback import SparsityCallback
from sb3_sparse.engine.optimizers import check_weight_decay
from sb3_sparse.errors import ConfigError, did_you_mean
from sb3_sparse.policies.arguments import import_classes
from sb3_sparse.policies.config import SPARSITY_MISSING, SparsityConfig
from sb3_sparse.topology import method_named
from sb3_sparse.zoo.arguments import kind_of
from sb3_sparse.zoo.settings import CALLBACK, SET_BY_THE_RUN, Names, Settings

OF_SPARSITY = frozenset(one.name for one in fields(SparsityConfig))


def check_settings(settings: Settings, algorithm: type[BaseAlgorithm]) -> None:
    """Reject settings that cannot be trained as they are.

    :raises ConfigError: for an unknown key, a value that is not allowed, or a sparsity
        that training would not reach
    """
    kwargs, callback = settings.policy_kwargs, settings.callback
    names = Names.of(algorithm)
    algo = algorithm.__name__
    _check_keys(settings, names.algorithm, f"{algo} and rl-zoo have no setting", names)
    _check_keys(kwargs, names.policy, f"policy_kwargs of {algo} have no", names)
    if callback is not None and not settings.has_own_callback:
        allowed = names.schedule | {"method", "verbose"}
        _check_keys(callback, allowed, f"{CALLBACK} has no argument", names)
    for part in (settings, kwargs, callback or {}, kwargs.get("optimizer_kwargs") or {}):
        for name, value in part.items():
            _check_value(algo.lower(), name, value)
    import_classes(dict(kwargs))
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
    SparsityConfig(**{name: value for name, value in kwargs.items() if name in OF_SPARSITY})
    check_weight_decay(kwargs.get("weight_decay", 0.0), kwargs.get("optimizer_kwargs"))
    if callback is not None and not settings.has_own_callback:
        SparsityCallback(**callback)
    _check_start(kwargs, callback)


def _check_keys(given: Mapping[str, Any], allowed: Set[str], what: str, names: Names) -> None:
    for name in given:
        if name in allowed:
            continue
        if name in names.policy:
            cure = "; it is the policy's: put it under policy_kwargs"
        elif name in names.schedule:
            cure = f"; it is the mask's schedule's: put it under {CALLBACK}"
        elif name in names.algorithm:
            cure = "; it is the algorithm's: put it beside policy_kwargs"
        elif name in SET_BY_THE_RUN:
            cure = "; it has its own option"
        else:
            cure = did_you_mean(name, allowed)
        raise ConfigError(f"{what} {name!r}{cure}. Allowed are {', '.join(sorted(allowed))}")


def _check_value(algo: str, name: str, value: Any) -> None:
    if isinstance(value, str) and _is_number(value):
        raise ConfigError(
            f"{name} is the text {value!r}, as YAML reads a number without a dot and a sign; write "
            f"{name}: !!float {value}"
        )
    kind = kind_of(algo, name)
    if kind is not None and not kind.fits(value):
        raise ConfigError(f"{name} must be {kind.allowed}; got {value!r}")


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _check_start(kwargs: Mapping[str, Any], callback: Mapping[str, Any] | None) -> None:
    """Require a method that prunes for a denser start, and a denser start for such a method."""
    initial, final = kwargs.get("initial_sparsity"), kwargs["sparsity"]
    shares = list(final.values()) if isinstance(final, Mapping) else [final]
    denser = initial is not None and any(initial < share for share in shares)
    prunes = callback is not None and method_named(callback["method"]).reaches_final
    if denser and not prunes:
        how = "without a callback" if callback is None else f"with method {callback['method']!r}"
        raise ConfigError(
            f"initial_sparsity: {initial} begins denser than sparsity: {final}, and {how} training "
            "would stay that dense; leave initial_sparsity out, or prune with "
            f"callback: [{{{CALLBACK}: {{method: prune}}}}]"
        )
    if prunes and not denser:
        assert callback is not None
        raise ConfigError(
            f"method {callback['method']!r} begins denser than it ends, but initial_sparsity is "
            f"{initial} and sparsity {final}; give initial_sparsity: 0.0 and a sparsity above 0"
        )
