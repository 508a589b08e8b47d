"""Base class of all algorithms: decides whether gradient steps can be fused, and runs them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Hashable, Iterable, Sequence
from itertools import chain
from operator import attrgetter
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_sparse.engine.activations import ADJUSTABLE, number_of
from sb3_sparse.engine.changes import ChangeDetector, patched
from sb3_sparse.engine.internals import any_global_hook, module_hooks
from sb3_sparse.engine.native.library import why_missing
from sb3_sparse.engine.norms import NORMS, is_warm, training_settings_of
from sb3_sparse.errors import UnsupportedError
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.machine import Machine
from sb3_sparse.fused.program import Program
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.fast_forward import only_flattens, overrides, takes_vectors
from sb3_sparse.policies.registry import possible_algorithms, registered
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


def features(policy: BasePolicy, obs: Any) -> th.Tensor:
    """Convert observations of a buffer to the input of the networks, in a type programs read.

    :param policy: the policy
    :param obs: shape ``(batch, *shape)``
    :raises NotCovered: for dict observations
    """
    if not isinstance(obs, th.Tensor):
        raise NotCovered("dict observations")
    if takes_vectors(policy):
        return obs.flatten(1)
    prepared = preprocess_obs(obs, policy.observation_space, policy.normalize_images)
    assert isinstance(prepared, th.Tensor)
    return prepared.flatten(1)


def mean(numbers: Sequence[float]) -> Any:
    """Average as ``np.mean`` does, but faster for a single number."""
    return np.float64(numbers[0]) if len(numbers) == 1 else np.mean(numbers)


class Fused(BaseAlgorithm):
    """Base class of algorithms whose gradient steps run in one call of the kernels if possible."""

    _training: Training

    def _setup_model(self) -> None:
        self._check_policy_class()
        super()._setup_model()  # type: ignore[safe-super]
        if isinstance(self.policy, BaseSparsePolicy):
            self.policy.use_kernels()  # also at sparsity 0, where the policy would stay SB3's

    def _check_policy_class(self) -> None:
        """Reject a policy of another algorithm, e.g. from a file that it saved.

        :raises UnsupportedError: for a policy class that is known to be of another algorithm
        """
        policy, known = self.policy_class, registered().values()
        if not isinstance(policy, type):
            return  # it raises when it is called: the algorithm has no such policy
        own = [one.stock_policy for one in known if isinstance(self, one.algorithm)]
        others = possible_algorithms(policy)
        if others and not issubclass(policy, tuple(own)):
            name = type(self).__name__
            raise UnsupportedError(
                f"{policy.__name__} is a policy of {' or '.join(others)}, not of {name}; make or "
                f"load the model with {others[0]}"
            )

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_training"]

    def _trains(self) -> Training:
        training = vars(self).get("_training")
        if training is None:
            training = self._training = Training()
        return training

    @abstractmethod
    def _next_machine(self) -> Machine:
        """Return the machine for the next gradient step.

        :raises NotCovered: if programs cannot compute it
        """

    def train(self, *args: Any, **kwargs: Any) -> None:
        """Train as SB3 does, with the arguments of the algorithm's ``train`` there.

        SB3 takes the gradient steps that programs do not cover, such as those of images or gSDE.
        """
        try:
            self._train_fused(*args, **kwargs)
        except NotCovered as why:
            self._not_covered(why)
            super().train(*args, **kwargs)  # type: ignore[misc]

    @abstractmethod
    def _train_fused(self, *args: Any, **kwargs: Any) -> None:
        """Take a round of gradient steps.

        :raises NotCovered: before the first, if programs do not cover them
        """

    def why_not_fused(self) -> str | None:
        """Tell why gradient steps are Stable-Baselines3's own; None: they are fused.

        This records a step of the present model without running it, which takes milliseconds.

        Example::

            from sb3_sparse import SAC

            kwargs = dict(sparsity=0.9)
            model = SAC("SparsePolicy", "Pendulum-v1", policy_kwargs=kwargs, use_sde=True)
            model.why_not_fused()  # 'gSDE'
        """
        try:
            self._next_machine()
        except NotCovered as why:
            return why.reason
        return None

    def _not_covered(self, why: NotCovered) -> None:
        """Log once why gradient steps are SB3's own, if the policy is sparse."""
        training = self._trains()
        training.reason = reason = why.reason
        if reason not in training.logged:
            training.logged.add(reason)
            if isinstance(unwrapped(self.policy), BaseSparsePolicy):
                self.logger.info(f"Gradient steps are Stable-Baselines3's own: {reason}")
