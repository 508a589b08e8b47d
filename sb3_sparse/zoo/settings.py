"""The settings of a run: a config's entry with the user's overrides."""

from __future__ import annotations

import dataclasses
import inspect
import json
from collections.abc import Iterable, Iterator, Mapping
from copy import deepcopy
from typing import TYPE_CHECKING, Any

from sb3_sparse.errors import ConfigError, did_you_mean
from sb3_sparse.policies.registry import SparsePolicy, SparseSimbaPolicy, policy_named
from sb3_sparse.topology import Methods
from sb3_sparse.zoo.callbacks import (
    CALLBACK,
    is_own,
    named,
    package_callback,
    robust_value_of,
    sparsity_callback,
    with_robust_value,
)
from sb3_sparse.zoo.configs import DENSE
from sb3_sparse.zoo.names import Names
from sb3_sparse.zoo.overrides import literal

if TYPE_CHECKING:  # imported when settings are checked, not when names are read
    from stable_baselines3.common.base_class import BaseAlgorithm

    from sb3_sparse.policies.base import BaseSparsePolicy

POLICIES = {f"sb3_sparse.{alias}": alias for alias in (SparsePolicy, SparseSimbaPolicy)}
"""The sparse policies that settings may name, as a dotted path or by the alias."""
COMPARED = frozenset({"sparsity", "initial_sparsity", "method", "callback", "policy_kwargs"})
"""Names that :meth:`Settings.variant` omits or lists separately."""


class Settings(Mapping[str, Any]):
    """The settings of a run, in the form of a config's entry. They are immutable.

    A mapping of rl-zoo's names: the algorithm's arguments, ``policy_kwargs``, ``callback``,
    ``n_timesteps`` and so on. ``policy_kwargs`` is always a mapping.

    Example::

        from sb3_sparse.zoo import RunSpec

        settings = RunSpec(algo="sac", env_id="Pendulum-v1", sparsity=0.9).settings()
        print(settings.method, settings.policy_kwargs["sparsity"], settings["n_timesteps"])

    :param content: the mapping; it is copied
    :param imports: whether dotted paths may be imported to identify them. False for settings
        that you do not trust: then a callback with a ``method`` counts as a SparsityCallback
    :raises ConfigError: if ``policy_kwargs`` or the callback has another form
    """

    def __init__(self, content: Mapping[str, Any], *, imports: bool = True) -> None:
        self._content = deepcopy(dict(content))
        self._content["policy_kwargs"] = _policy_kwargs(self._content)
        self._imports = imports

    def __getitem__(self, name: str) -> Any:
        return deepcopy(self._content[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._content)

    def __len__(self) -> int:
        return len(self._content)

    def __repr__(self) -> str:
        return f"Settings({self._content!r})"

    def as_dict(self) -> dict[str, Any]:
        """Return a copy that you may change."""
        return deepcopy(self._content)

    @property
    def policy_kwargs(self) -> dict[str, Any]:
        """The policy's arguments."""
        kwargs: dict[str, Any] = self["policy_kwargs"]
        return kwargs

    @property
    def alias(self) -> str:
        """The name by which algorithms know the policy, e.g. ``"SparsePolicy"``.

        :raises ConfigError: if the policy is not sparse
        """
        policy = self.get("policy")
        alias = POLICIES.get(str(policy), policy)
        if alias not in POLICIES.values():
            raise ConfigError(
                f"the policy must be {' or '.join(POLICIES)} (with sparsity 0.0 for dense "
                f"training), got {policy!r}"
            )
        return str(alias)

    def policy_class(self, algorithm: type[BaseAlgorithm]) -> type[BaseSparsePolicy]:
        """Return the class that an algorithm makes the policy of.

        :raises ConfigError: if the policy is not sparse, or if the algorithm does not have it
        """
        return policy_named(algorithm, self.alias)

    @property
    def callback(self) -> Mapping[str, Any] | None:
        """The arguments of the SparsityCallback; None if the settings have none.

        :raises ConfigError: if a callback has another form, or lacks its method
        """
        found = sparsity_callback(self._content, self._imports)
        return None if found is None else deepcopy(found[1])

    @property
    def has_own_callback(self) -> bool:
        """Whether the callback is a user's subclass, which may take other arguments."""
        found = sparsity_callback(self._content, self._imports)
        return found is not None and found[0]

    @property
    def methods(self) -> Methods | None:
        """The callback's topology methods; None if the settings have no SparsityCallback.

        :raises ConfigError: as :attr:`callback`, and for an unknown method
        """
        callback = self.callback
        return None if callback is None else Methods.of(callback["method"])

    @property
    def robust_value(self) -> Mapping[str, Any] | None:
        """The arguments of the RobustValueCallback; None if the settings have none.

        :raises ConfigError: if they are no mapping
        """
        return deepcopy(robust_value_of(self._content))

    @property
    def method(self) -> str:
        """The topology method; ``"static"`` without a callback, ``"dense"`` at sparsity 0.

        Methods by network read ``"actor=set, critic=rigl"``; static networks are left out.

        :raises ConfigError: if the policy is not sparse
        """
        self.alias  # noqa: B018  # rejects a policy that is not sparse
        methods = self.methods
        if methods is not None:
            return methods.label
        return DENSE if self.is_dense else "static"

    @property
    def is_dense(self) -> bool:
        """Whether every network is dense, and stays so.

        :raises ConfigError: as :attr:`callback`, and for an unknown method
        """
        methods = self.methods
        sparsity = self.policy_kwargs.get("sparsity")
        shares = list(sparsity.values()) if isinstance(sparsity, Mapping) else [sparsity]
        still = methods is None or not methods.options
        return still and all(share == 0.0 for share in shares)

    @property
    def kind(self) -> tuple[str, str, tuple[str, ...]]:
        """What a preset stands for: the policy's alias, the method, and further callbacks.

        :raises ConfigError: as :attr:`alias` and :attr:`callback`
        """
        alias, method = self.alias, self.method
        paths = [path for path, _ in named(self._content) if is_own(path) is None]
        return alias, method, tuple(sorted(package_callback(path) or path for path in paths))

    def changed(self, overrides: Mapping[str, Any], algorithm: type[BaseAlgorithm]) -> Settings:
        """Return these settings with each override in its place: a callback, policy or algorithm.

        The names do not overlap, so ``update_interval``, ``weight_decay`` and ``learning_rate``
        each find their own place. A mapping that overrides a mapping is merged into it.

        :param overrides: values by name
        :param algorithm: the algorithm that the settings are for
        :raises ConfigError: for a name that none of them has
        """
        content = self.as_dict()
        policy = overrides.get("policy", self.get("policy"))
        names = Names.of(algorithm, self.replaced(policy=policy).alias)
        for name, value in overrides.items():
            if name in names.algorithm:
                content[name] = _merged(content.get(name), value)
            elif name in names.policy:
                content["policy_kwargs"] = {**_policy_kwargs(content), name: value}
            elif name in names.schedule:
                found = sparsity_callback(content, self._imports)
                if found is None:
                    raise ConfigError(
                        f"{name} means nothing here: these settings train without {CALLBACK}"
                    )
                found[1][name] = _merged(found[1].get(name), value)
            elif name in names.robust_value:
                content["callback"] = with_robust_value(content, name, value)
            else:
                raise ConfigError(
                    f"{algorithm.__name__} has no hyperparameter {name!r}"
                    f"{did_you_mean(name, names.all)}. Of the algorithm: "
                    f"{_listed(names.algorithm)}. Of the policy: {_listed(names.policy)}. Of the "
                    f"mask's schedule: {_listed(names.schedule)}. Of the RobustValueCallback: "
                    f"{_listed(names.robust_value)}"
                )
        if "sparsity" in overrides and "initial_sparsity" not in overrides:
            self._move_start(content["policy_kwargs"])
        return Settings(content, imports=self._imports)

    def _move_start(self, kwargs: dict[str, Any]) -> None:
        """Let a start that is the method's usual one follow the sparsity, e.g. half of it.

        :param kwargs: the policy's arguments with another sparsity
        """
        start, methods = kwargs.get("initial_sparsity"), self.methods
        usual = methods and methods.initial_sparsity(self.policy_kwargs.get("sparsity"))
        if methods and start and start == usual:
            kwargs["initial_sparsity"] = methods.initial_sparsity(kwargs["sparsity"])

    def with_methods(self, methods: Methods) -> Settings:
        """Return these settings with other topology methods.

        The callback keeps the options that any of them uses; networks start as their methods
        usually do.
        """
        content = self.as_dict()
        found = sparsity_callback(content, self._imports)
        if found is None:
            content["callback"] = [{CALLBACK: {}}]
            arguments = content["callback"][0][CALLBACK]
        else:
            arguments = found[1]
        kept = {name: value for name, value in arguments.items() if name in methods.options}
        arguments.clear()
        arguments.update(method=dict(methods.named) or methods.usual, **kept)
        kwargs = content["policy_kwargs"]
        kwargs.pop("initial_sparsity", None)
        start = methods.initial_sparsity(kwargs.get("sparsity"))
        if start is not None:
            kwargs["initial_sparsity"] = start
        return Settings(content, imports=self._imports)

    def replaced(self, **content: Any) -> Settings:
        """Return these settings with other values for some of rl-zoo's names."""
        return Settings({**self._content, **content}, imports=self._imports)

    def value(self, name: str, algorithm: type[BaseAlgorithm] | None = None) -> Any:
        """Return a setting of the policy, the callback or the algorithm.

        :param algorithm: gives the default where the settings lack the name
        :return: the value; ``"default"`` where neither the settings nor the algorithm have one
        """
        for place in (self.policy_kwargs, self.callback or {}, self.robust_value or {}, self):
            if name in place:
                return place[name]
        if name == "weight_decay":
            return 0.0
        from sb3_sparse.policies.config import SparsityConfig

        for one in dataclasses.fields(SparsityConfig):
            if one.name == name and one.default is not dataclasses.MISSING:
                return one.default
        if algorithm is not None:
            parameter = inspect.signature(algorithm).parameters.get(name)
            if parameter is not None and parameter.default is not parameter.empty:
                return parameter.default
        return "default"

    def variant(self, without: Iterable[str] = ()) -> str:
        """Return all settings but method and sparsity as one comparable string.

        :param without: further names to omit
        """
        hidden = {*COMPARED, *without}

        def kept(values: Mapping[str, Any]) -> dict[str, Any]:
            return {name: value for name, value in values.items() if name not in hidden}

        sparsity = self.callback
        parts = {"policy_kwargs": kept(self.policy_kwargs), "callback": kept(sparsity or {})}
        others = {
            path: kept(given) if isinstance(given, Mapping) else given
            for path, given in named(self._content)
            if given != sparsity
        }
        if others:
            parts["callbacks"] = others
        return json.dumps({**kept(self), **parts}, sort_keys=True, default=str)


def _merged(known: Any, value: Any) -> Any:
    """Return a value in the place of a known one; a mapping of a mapping is merged into it."""
    both = isinstance(known, Mapping) and isinstance(value, Mapping)
    return {**known, **value} if both else value


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(names))


def _policy_kwargs(settings: Mapping[str, Any]) -> dict[str, Any]:
    kwargs = settings.get("policy_kwargs", {})
    if isinstance(kwargs, str):
        kwargs = literal(kwargs)
    if not isinstance(kwargs, dict):
        raise ConfigError(
            f"policy_kwargs must be a mapping of plain values, got {kwargs!r}; e.g. "
            "{sparsity: 0.9, net_arch: [256, 256], activation_fn: torch.nn.ReLU}"
        )
    return kwargs
