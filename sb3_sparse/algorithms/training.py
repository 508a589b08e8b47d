"""Decides whether gradient steps of a model can be fused, and keeps the machines that run them."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence
from itertools import chain
from operator import attrgetter
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_sparse.engine.activations import ADJUSTABLE, number_of
from sb3_sparse.engine.changes import ChangeDetector, patched
from sb3_sparse.engine.internals import any_global_hook, module_hooks
from sb3_sparse.engine.native.library import why_missing
from sb3_sparse.engine.norms import NORMS, is_warm, training_settings_of
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.machine import Machine
from sb3_sparse.fused.program import Program
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.fast_forward import only_flattens, overrides
from sb3_sparse.policies.storage import KNOWN_PACKAGES

SEEN = attrgetter("requires_grad", "_backward_hooks", "_post_accumulate_grad_hooks")
Build = Callable[[Program], None]
Methods = dict[str, tuple[str, ...]]
"""The methods that SB3's ``train()`` calls, by the dotted name of their module ("": the policy)."""


class Training:
    """Owns the machines of a model. Copies and pickles start without any."""

    def __init__(self) -> None:
        self._machines: dict[Hashable, Machine] = {}
        self._changes: ChangeDetector | None = None
        self._hooked: list[dict[str, Any]] = []
        self._tensors: list[Any] = []
        self._seen: list[Any] = []
        self._adjustable: list[nn.Module] = []
        self._norms: list[nn.Module] = []
        self._renorms: list[nn.Module] = []
        self._warm: list[bool] = []
        self._acting: list[dict[str, Any]] = []
        self._settings: list[Any] = []
        self._policy: Any = None
        self._prepared: Machine | None = None
        self.reason: str | None = None
        """Reason why SB3 took the last gradient steps; None: they were fused."""
        self.logged: set[str] = set()
        """Reasons that have been logged."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Training:
        return Training()

    def __reduce__(self) -> Any:
        return Training, ()

    def begin(
        self,
        model: BaseAlgorithm,
        methods: Methods,
        others: Sequence[th.Tensor] = (),
    ) -> None:
        """Inspect the policy of a model before a round of gradient steps.

        :param model: the model
        :param methods: the methods that SB3's ``train()`` calls
        :param others: parameters that are trained besides the policy's
        :raises NotCovered: if skipping these methods would change the result
        """
        policy = model.policy
        if unwrapped(policy) is not policy:
            raise NotCovered("the policy is compiled")
        if not isinstance(policy, BaseSparsePolicy):
            raise NotCovered(f"the policy, {type(policy).__name__}, is not sparse")
        settings = self._settings_now()
        if self._changes is None or settings != self._settings or not self._changes.unchanged():
            self._changes = None
            self._machines.clear()
            _check_policy(policy, methods)
            modules = list(policy.modules())
            self._hooked = list(map(vars, modules))
            self._tensors = [*_trained(policy)]
            self._adjustable = [m for m in modules if isinstance(m, ADJUSTABLE)]
            self._norms = [m for m in modules if isinstance(m, tuple(NORMS))]
            self._renorms = [m for m in self._norms if not isinstance(m, nn.LayerNorm)]
            self._acting = [vars(m) for m in modules if "action_dist" in vars(m)]
            self._settings = self._settings_now()
            self._changes = ChangeDetector(modules)
        for name in methods:
            if vars(model).get(name) is not policy._modules.get(name) and hasattr(model, name):
                raise NotCovered(f"{name} is another module in the model than in its policy")
        if any(chain.from_iterable(map(module_hooks, self._hooked))) or any_global_hook():
            raise NotCovered("hooks on modules")
        tensors = [*self._tensors, *others]
        found = chain.from_iterable(map(SEEN, tensors))
        seen = [len(hooks) if hooks and hooks is not True else hooks for hooks in found]
        if seen != self._seen:
            self._seen = []
            if any(map(_is_watched, tensors)):
                raise NotCovered("hooks on parameters")
            if not all(parameter.requires_grad for parameter in _trained(policy)):
                raise NotCovered("parameters that are frozen")
            self._seen = seen
        if th.is_autocast_enabled("cpu") or th.is_anomaly_enabled():
            raise NotCovered("autocast or anomaly detection")
        for tensor in tensors:
            tensor.grad = None  # as at the start of SB3's steps
        self._policy, self._prepared = policy, None

    def _settings_now(self) -> list[Any]:
        """Collect what may change while modules, tensors and attributes stay the same."""
        distributions = [attributes["action_dist"] for attributes in self._acting]
        norms = map(training_settings_of, self._norms)
        activations = map(number_of, self._adjustable)
        return [*activations, *norms, *distributions, *map(type, distributions)]

    def machine(
        self,
        key: tuple[Hashable, ...],
        batch: int,
        optimizers: Sequence[th.optim.Optimizer],
        build: Build,
    ) -> Machine:
        """Return the machine for the next gradient step.

        :param key: what the program depends on besides policy and optimizers
        :param batch: maximum batch size
        :param optimizers: the optimizers that take a step
        :param build: records the program
        :raises NotCovered: if programs cannot compute it
        """
        warm = [is_warm(norm) for norm in self._renorms]
        if warm != self._warm:
            self._machines.clear()
            self._warm = warm
        sparse = self._policy.sparse
        capture = [o for o in optimizers if sparse.needs_torch(o) and sparse.wants_gradients(o)]
        whole = (*key, th.get_num_threads(), *map(id, optimizers), -1, *map(id, capture))
        machine = self._machines.get(whole)
        if machine is None or machine.capacity < batch:
            program = Program(capture)
            build(program)
            machine = self._machines[whole] = Machine(program, sparse, batch)
        if machine is not self._prepared:
            machine.prepare()
            self._prepared = machine
        self.reason = None
        return machine


def _check_policy(policy: BaseSparsePolicy, methods: Methods) -> None:
    if (missing := why_missing()) is not None:
        raise NotCovered(f"there are no kernels: {missing}")
    if policy.device.type != "cpu":
        raise NotCovered(f"the policy is on {policy.device}")
    for module in policy.modules():  # first: images come here before each round
        if isinstance(module, BaseFeaturesExtractor) and not only_flattens(module):
            raise NotCovered(f"the features extractor {type(module).__name__}")
    for name, module in policy.named_modules():
        if getattr(module, "use_sde", False):
            raise NotCovered("gSDE")
        if patched(module):
            raise NotCovered(f"{name or 'the policy'} has methods of its own")
        distribution: Any = type(getattr(module, "action_dist", None))
        if distribution.__module__.partition(".")[0] not in (*KNOWN_PACKAGES, "builtins"):
            raise NotCovered(f"the distribution {distribution.__name__}")
    for name, called in methods.items():
        if overrides(policy.get_submodule(name), called):
            raise NotCovered(f"{name or 'the policy'} has methods of its own")


def _is_watched(tensor: Any) -> bool:
    hooks = (tensor._backward_hooks, tensor._post_accumulate_grad_hooks)
    return any(
        not getattr(hook, "__module__", "").startswith("sb3_sparse.")
        for named in hooks if named
        for hook in named.values()
    )  # fmt: skip


def _trained(policy: BaseSparsePolicy) -> Iterable[th.Tensor]:
    for optimizer in policy.sparse.optimizers:
        for group in optimizer.param_groups:
            yield from group["params"]
