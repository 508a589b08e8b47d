"""The settings of a run: a config's entry with what the user wants otherwise."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from functools import cache
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_sparse.callback import SparsityCallback
from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.aliases import SparsePolicy
from sb3_sparse.policies.config import SPARSITY_MISSING
from sb3_sparse.policies.named import import_path
from sb3_sparse.topology import method_named

POLICY = f"sb3_sparse.{SparsePolicy}"
CALLBACK = f"sb3_sparse.{SparsityCallback.__name__}"
# What rl-zoo reads itself, beside the arguments of the algorithm's constructor.
ZOO_KEYS = frozenset(
    ("callback", "env_kwargs", "env_wrapper", "frame_stack", "monitor_kwargs", "n_envs")
    + ("n_timesteps", "noise_std", "noise_type", "normalize", "policy", "policy_kwargs")
    + ("vec_env_wrapper",)
)

# Arguments of every algorithm that a run sets itself, by options of their own.
SET_BY_THE_ENGINE = frozenset({"device", "seed", "tensorboard_log", "verbose"})
SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf")


def parse_overrides(texts: Iterable[str]) -> dict[str, Any]:
    """``["learning_rate:0.001", ...]`` as rl-zoo's ``--hyperparams`` takes them.

    A value is a Python literal or ``dict(...)`` of literals; all else (``lin_0.001``, a dotted
    path) is text.

    :raises ConfigError: for a text without a colon
    """
    overrides: dict[str, Any] = {}
    for text in texts:
        name, colon, value = text.partition(":")
        if not colon or not name or not value:
            raise ConfigError(
                f"hyperparameters are given as name:value, e.g. learning_rate:0.001, got {text!r}"
            )
        overrides[name] = _value(value)
    return overrides


class _DictCalls(ast.NodeTransformer):
    """Turns ``dict(a=1)``, as the zoo's files write it, into ``{"a": 1}``."""

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        if not (isinstance(node.func, ast.Name) and node.func.id == "dict") or node.args:
            return node
        keys: list[ast.expr | None] = [ast.Constant(keyword.arg) for keyword in node.keywords]
        return ast.Dict(keys=keys, values=[keyword.value for keyword in node.keywords])


def _value(text: str) -> Any:
    try:
        return ast.literal_eval(_DictCalls().visit(ast.parse(text.strip(), mode="eval")))
    except (ValueError, SyntaxError):
        return text


def apply_overrides(
    settings: dict[str, Any], overrides: Mapping[str, Any], algorithm: type[BaseAlgorithm]
) -> None:
    """Put each override where it belongs: callback, policy or algorithm; in place.

    The names do not overlap, so ``update_interval``, ``weight_decay`` and ``learning_rate`` each
    find their own place. A mapping given for a mapping (``policy_kwargs``) is merged into it.

    :raises ConfigError: for a name that none of them has
    """
    of_callback = _arguments(SparsityCallback) - {"method", "verbose"}
    of_policy = _arguments(algorithm.policy_aliases[SparsePolicy]) - {"kwargs"}
    of_algorithm = (_arguments(algorithm) - SET_BY_THE_ENGINE) | ZOO_KEYS
    for name, value in overrides.items():
        if name in of_algorithm:
            known = settings.get(name)
            both = isinstance(known, Mapping) and isinstance(value, Mapping)
            settings[name] = {**known, **value} if both and known else value
        elif name in of_policy:
            settings["policy_kwargs"] = {**policy_kwargs_of(settings), name: value}
        elif name in of_callback:
            sparsity_callback(settings, name)[name] = value
        else:
            known_names = of_algorithm | of_policy | of_callback
            close = get_close_matches(name, known_names, n=1)
            raise ConfigError(
                f"{algorithm.__name__} has no hyperparameter {name!r}"
                + (f"; did you mean {close[0]!r}?" if close else "")
                + f" Of the algorithm: {_listed(of_algorithm)}. Of the policy: "
                f"{_listed(of_policy)}. Of the mask's schedule: {_listed(of_callback)}"
            )


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(names))


@cache
def _arguments(cls: type) -> frozenset[str]:
    """Names that a class and its bases take when made, but those that every SB3 class is given."""
    names: set[str] = set()
    for base in cls.__mro__:
        if "__init__" in vars(base) and base.__module__.split(".")[0] != "torch":
            names.update(inspect.signature(vars(base)["__init__"]).parameters)
    given = (
        "self args kwargs env observation_space action_space lr_schedule supported_action_spaces"
    )
    return frozenset(names - {*given.split(), "_init_setup_model", "support_multi_env"})


def sparsity_callback(settings: Mapping[str, Any], wanted: str = "") -> dict[str, Any]:
    """The arguments of the SparsityCallback in the settings, to read or to change.

    :param wanted: what is to be set, for the message
    :raises ConfigError: if there is no such callback
    """
    arguments = find_callback(settings)
    if arguments is None:
        raise ConfigError(f"{wanted} means nothing here: these settings train without {CALLBACK}")
    return arguments


def find_callback(settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """The arguments of the SparsityCallback in the settings; None where there is none."""
    callbacks = settings.get("callback") or []
    for callback in callbacks if isinstance(callbacks, list) else [callbacks]:
        named = callback if isinstance(callback, dict) else {callback: {}}
        if len(named) != 1:
            raise ConfigError(
                f"a callback is one path, with its arguments indented below it, got {callback!r}"
            )
        ((path, arguments),) = named.items()
        if _is_ours(path):
            if "method" not in (arguments or {}):
                raise ConfigError(f"{path} needs a method, e.g. {path}: {{method: rigl}}")
            found: dict[str, Any] = arguments
            return found
    return None


def _is_ours(path: str) -> bool:
    try:
        return import_path(path) is SparsityCallback
    except ImportError:
        return False  # rl-zoo says so when it imports it


def check_values(settings: Mapping[str, Any]) -> None:
    """Refuse what YAML has read as text but was meant as a number.

    :raises ConfigError: if there is any
    """
    callback = find_callback(settings) or {}
    for part in (settings, policy_kwargs_of(settings), callback):
        for name, value in part.items():
            if isinstance(value, str) and _is_number(value):
                raise ConfigError(
                    f"{name} is the text {value!r}, as YAML reads a number without a dot and a "
                    f"sign; write {name}: !!float {value}"
                )
    for name in SCHEDULES:
        value = settings.get(name)
        if isinstance(value, str) and not _is_number(value.removeprefix("lin_")):
            raise ConfigError(
                f"{name} must be a number, or lin_ and a number for a linear decay to 0, e.g. "
                f"lin_0.001, got {value!r}"
            )
    if "sparsity" not in policy_kwargs_of(settings):
        raise ConfigError(SPARSITY_MISSING)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def method_of(settings: Mapping[str, Any]) -> str:
    """The method that the settings train with.

    :raises ConfigError: if their policy is not sparse, or they say contradictory things
    """
    policy = settings.get("policy")
    if policy not in (POLICY, SparsePolicy):
        raise ConfigError(
            f"the policy must be {POLICY} (with sparsity 0.0 for dense training), got {policy!r}"
        )
    callback = find_callback(settings)
    if callback is not None:
        return method_named(callback["method"]).name
    sparsity = policy_kwargs_of(settings).get("sparsity")
    return "dense" if sparsity == 0.0 else "static"


def policy_kwargs_of(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The policy's arguments in the settings.

    :raises ConfigError: if they are no mapping
    """
    kwargs = settings.get("policy_kwargs", {})
    if isinstance(kwargs, str):
        kwargs = _value(kwargs)
    if not isinstance(kwargs, dict):
        raise ConfigError(
            f"policy_kwargs must be a mapping of plain values, got {kwargs!r}; e.g. "
            "{sparsity: 0.9, net_arch: [256, 256], activation_fn: torch.nn.ReLU}"
        )
    return kwargs
