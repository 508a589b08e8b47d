"""The settings of a run: a config's entry with what the user wants otherwise."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sb3_sparse.errors import ConfigError, did_you_mean
from sb3_sparse.policies.arguments import arguments_of, import_path
from sb3_sparse.topology import method_named

if TYPE_CHECKING:  # which is imported when settings are checked, not when names are read
    from stable_baselines3.common.base_class import BaseAlgorithm

POLICY = "sb3_sparse.SparsePolicy"
ALIAS = "SparsePolicy"
CALLBACK = "sb3_sparse.SparsityCallback"
# What rl-zoo reads itself, beside the arguments of the algorithm's constructor.
ZOO_KEYS = frozenset(
    ("callback", "env_kwargs", "env_wrapper", "frame_stack", "monitor_kwargs", "n_envs")
    + ("n_timesteps", "noise_std", "noise_type", "normalize", "policy", "policy_kwargs")
    + ("vec_env_wrapper",)
)

# Arguments of every algorithm that a run sets itself, by options of their own.
SET_BY_THE_ENGINE = frozenset({"device", "seed", "tensorboard_log", "verbose"})


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


@dataclass(frozen=True)
class Names:
    """The arguments that settings may hold, by whose they are. They do not overlap.

    :param algorithm: of the algorithm's constructor and of rl-zoo
    :param policy: of the sparse policy
    :param schedule: of the SparsityCallback, but for its method
    """

    algorithm: frozenset[str]
    policy: frozenset[str]
    schedule: frozenset[str]

    @classmethod
    def of(cls, algorithm: type[BaseAlgorithm]) -> Names:
        """Those that go with an algorithm."""
        from sb3_sparse.callback import SparsityCallback

        return cls(
            (arguments_of(algorithm) - SET_BY_THE_ENGINE) | ZOO_KEYS,
            arguments_of(algorithm.policy_aliases[ALIAS]),
            arguments_of(SparsityCallback) - {"method", "verbose"},
        )


def apply_overrides(
    settings: dict[str, Any], overrides: Mapping[str, Any], algorithm: type[BaseAlgorithm]
) -> None:
    """Put each override where it belongs: callback, policy or algorithm; in place.

    The names do not overlap, so ``update_interval``, ``weight_decay`` and ``learning_rate`` each
    find their own place. A mapping given for a mapping (``policy_kwargs``) is merged into it.

    :raises ConfigError: for a name that none of them has
    """
    names = Names.of(algorithm)
    for name, value in overrides.items():
        if name in names.algorithm:
            known = settings.get(name)
            both = isinstance(known, Mapping) and isinstance(value, Mapping)
            settings[name] = {**known, **value} if both and known else value
        elif name in names.policy:
            settings["policy_kwargs"] = {**policy_kwargs_of(settings), name: value}
        elif name in names.schedule:
            sparsity_callback(settings, name)[name] = value
        else:
            known_names = names.algorithm | names.policy | names.schedule
            raise ConfigError(
                f"{algorithm.__name__} has no hyperparameter {name!r}"
                f"{did_you_mean(name, known_names)}. Of the algorithm: "
                f"{_listed(names.algorithm)}. Of the policy: {_listed(names.policy)}. Of the "
                f"mask's schedule: {_listed(names.schedule)}"
            )


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(names))


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
    found = _our_callback(settings)
    return None if found is None else found[1]


def has_own_callback(settings: Mapping[str, Any]) -> bool:
    """Whether the callback is a subclass of the user's, which may take other arguments."""
    found = _our_callback(settings)
    return found is not None and found[0]


def _our_callback(settings: Mapping[str, Any]) -> tuple[bool, dict[str, Any]] | None:
    """Whether the callback is a subclass of the user's, and its arguments."""
    callbacks = settings.get("callback") or []
    for callback in callbacks if isinstance(callbacks, list) else [callbacks]:
        named = callback if isinstance(callback, dict) else {callback: {}}
        if len(named) != 1:
            raise ConfigError(
                f"a callback is one path, with its arguments indented below it, got {callback!r}"
            )
        ((path, arguments),) = named.items()
        own = _is_own(path)
        if own is not None:
            if not isinstance(arguments, dict) or "method" not in arguments:
                raise ConfigError(f"{path} needs a method, e.g. {path}: {{method: rigl}}")
            return own, arguments
    return None


def _is_own(path: object) -> bool | None:
    """Whether a path names a subclass of SparsityCallback; None: neither that nor itself."""
    if not isinstance(path, str):
        raise ConfigError(f"a callback is a dotted path, e.g. {CALLBACK}, got {path!r}")
    if path == CALLBACK:
        return False
    from sb3_sparse.callback import SparsityCallback

    try:
        found = import_path(path)
    except ImportError:
        return None  # rl-zoo says so when it imports it
    ours = isinstance(found, type) and issubclass(found, SparsityCallback)
    return found is not SparsityCallback if ours else None


def method_of(settings: Mapping[str, Any]) -> str:
    """The method that the settings train with.

    :raises ConfigError: if their policy is not sparse, or they say contradictory things
    """
    policy = settings.get("policy")
    if policy not in (POLICY, ALIAS):
        raise ConfigError(
            f"the policy must be {POLICY} (with sparsity 0.0 for dense training), got {policy!r}"
        )
    callback = find_callback(settings)
    if callback is not None:
        return method_named(callback["method"]).name
    sparsity = policy_kwargs_of(settings).get("sparsity")
    shares = list(sparsity.values()) if isinstance(sparsity, Mapping) else [sparsity]
    return "dense" if all(share == 0.0 for share in shares) else "static"


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
