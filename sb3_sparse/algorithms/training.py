"""What the algorithms have in common: whether their gradient steps can be fused, and how."""

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

from sb3_sparse.engine.activations import ACTIVATIONS, ADJUSTABLE, number_of
from sb3_sparse.engine.changes import ChangeDetector, patched
from sb3_sparse.engine.internals import any_global_hook, module_hooks
from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.native.library import why_missing
from sb3_sparse.engine.paths import parts_of
from sb3_sparse.errors import UnsupportedError
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.machine import Machine
from sb3_sparse.fused.program import Parts, Program
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.registry import registered, writers_of
from sb3_sparse.policies.shortcut import only_flattens, takes_vectors, untouched
from sb3_sparse.policies.storage import KNOWN

SEEN = attrgetter("requires_grad", "_backward_hooks", "_post_accumulate_grad_hooks")
KNOWN_MODULES = (nn.Linear, SparseLinear, nn.Identity, *ACTIVATIONS)
Build = Callable[[Program], None]


class Training:
    """The machines of a model. Copies and pickles begin without any."""

    def __init__(self) -> None:
        self._machines: dict[Hashable, Machine] = {}
        self._changes: ChangeDetector | None = None
        self._hooked: list[dict[str, Any]] = []
        self._tensors: list[Any] = []
        self._seen: list[Any] = []
        self._adjustable: list[nn.Module] = []
        self._acting: list[dict[str, Any]] = []
        self._settings: list[Any] = []
        self._policy: Any = None
        self._prepared: Machine | None = None
        self.reason: str | None = None
        """Why the last gradient steps were SB3's own; None: they were fused."""
        self.said: set[str] = set()
        """Reasons that the log has told."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Training:
        return Training()

    def __reduce__(self) -> Any:
        return Training, ()

    def begin(
        self,
        model: BaseAlgorithm,
        methods: dict[str, tuple[str, ...]],
        others: Sequence[th.Tensor] = (),
    ) -> None:
        """Look at the policy of a model before a round of gradient steps.

        :param methods: by the dotted name of a module ("": the policy), those that SB3's
            ``train()`` calls
        :param others: parameters that are trained beside the policy's
        :raises NotCovered: if somebody would notice, or miss, that SB3 does not call them
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
            tensor.grad = None  # as SB3's steps begin
        self._policy, self._prepared = policy, None

    def _settings_now(self) -> list[Any]:
        """What can change without a module, a tensor or a name that comes or goes."""
        distributions = [attributes["action_dist"] for attributes in self._acting]
        return [*map(number_of, self._adjustable), *distributions, *map(type, distributions)]

    def machine(
        self,
        key: tuple[Hashable, ...],
        batch: int,
        optimizers: Sequence[th.optim.Optimizer],
        build: Build,
    ) -> Machine:
        """What runs the next gradient step.

        :param key: what a program depends on beside policy and optimizers
        :param batch: the largest there will be
        :param optimizers: those that will take a step
        :param build: records the program
        :raises NotCovered: if programs cannot compute it
        """
        sparse = self._policy.sparse
        capture = [o for o in optimizers if sparse.awaits(o) and sparse.wants_gradients(o)]
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


def _check_policy(policy: BaseSparsePolicy, methods: dict[str, tuple[str, ...]]) -> None:
    if (missing := why_missing()) is not None:
        raise NotCovered(f"there are no kernels: {missing}")
    if policy.device.type != "cpu":
        raise NotCovered(f"the policy is on {policy.device}")
    for name, module in policy.named_modules():
        if getattr(module, "use_sde", False):
            raise NotCovered("gSDE")
        if patched(module):
            raise NotCovered(f"{name or 'the policy'} has methods of its own")
        distribution: Any = type(getattr(module, "action_dist", None))
        if distribution.__module__.partition(".")[0] not in (*KNOWN, "builtins"):
            raise NotCovered(f"the distribution {distribution.__name__}")
    for name, called in methods.items():
        if not untouched(policy.get_submodule(name), called):
            raise NotCovered(f"{name or 'the policy'} has methods of its own")
    for module in policy.modules():
        if isinstance(module, BaseFeaturesExtractor) and not only_flattens(module):
            raise NotCovered(f"the features extractor {type(module).__name__}")


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


def parts(*modules: nn.Module) -> Parts:
    """Linear layers and activations of a network.

    :raises NotCovered: if there is anything else in it
    """
    found = parts_of(modules)
    if found is None:
        inner = (m for module in modules for m in module.modules() if not list(m.children()))
        others = {type(m).__name__ for m in inner if type(m) not in KNOWN_MODULES}
        raise NotCovered(f"a network with {', '.join(sorted(others)) or 'modules of its own'}")
    return found


def features(policy: BasePolicy, obs: Any) -> th.Tensor:
    """Observations as the networks get them, in numbers that programs read.

    :param obs: of a buffer, shape ``(batch, *shape)``
    """
    if not isinstance(obs, th.Tensor):
        raise NotCovered("dict observations")
    if takes_vectors(policy):
        return obs.flatten(1)
    prepared = preprocess_obs(obs, policy.observation_space, policy.normalize_images)
    assert isinstance(prepared, th.Tensor)
    return prepared.flatten(1)


def mean(numbers: Sequence[float]) -> Any:
    """As ``np.mean``; of one number, as there is where each step is followed by a gradient step,
    that one.
    """
    return np.float64(numbers[0]) if len(numbers) == 1 else np.mean(numbers)


class Fused(BaseAlgorithm):
    """An algorithm whose gradient steps run in one call of the kernels where they can."""

    _training: Training

    def _setup_model(self) -> None:
        self._check_policy_class()
        super()._setup_model()  # type: ignore[safe-super]
        if isinstance(self.policy, BaseSparsePolicy):
            self.policy.use_kernels()  # also where it has no zeros, and so would stay stock SB3's

    def _check_policy_class(self) -> None:
        """Reject policies of other algorithms, of a file that another one saved, say.

        :raises UnsupportedError: for a policy class that is known to be of another algorithm
        """
        policy, known = self.policy_class, registered().values()
        own = [one.stock_policy for one in known if isinstance(self, one.algorithm)]
        others = writers_of(policy)
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
        """What would run the next gradient step.

        :raises NotCovered: if programs cannot compute it
        """

    def train(self, *args: Any, **kwargs: Any) -> None:
        """As in SB3, with the arguments that the algorithm's ``train`` has there.

        What programs do not cover, such as images or gSDE, SB3 trains.
        """
        try:
            self._train_fused(*args, **kwargs)
        except NotCovered as why:
            self._not_covered(why)
            super().train(*args, **kwargs)  # type: ignore[misc]

    @abstractmethod
    def _train_fused(self, *args: Any, **kwargs: Any) -> None:
        """A round of gradient steps.

        :raises NotCovered: before it has begun, if programs do not cover them
        """

    def why_not_fused(self) -> str | None:
        """Why gradient steps are Stable-Baselines3's own; None: they are fused.

        It is found out by recording one, as the model is now, without running it: some
        milliseconds, once. ::

            model = SAC("SparsePolicy", env, use_sde=True, policy_kwargs=dict(sparsity=0.9))
            model.why_not_fused()  # 'gSDE'
        """
        try:
            self._next_machine()
        except NotCovered as why:
            return why.reason
        return None

    def _not_covered(self, why: NotCovered) -> None:
        """Let the log say once why gradient steps are SB3's own, where the policy is sparse."""
        training = self._trains()
        training.reason = reason = why.reason
        if reason not in training.said:
            training.said.add(reason)
            if isinstance(unwrapped(self.policy), BaseSparsePolicy):
                self.logger.info(f"Gradient steps are Stable-Baselines3's own: {reason}")
