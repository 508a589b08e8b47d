"""The base class of all sparse policies."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule

from sb3_sparse.engine.auto import AutoCompute
from sb3_sparse.engine.controller import Controller
from sb3_sparse.engine.layer import check_conversion
from sb3_sparse.engine.optimizers import check_weight_decay, prefer_fused
from sb3_sparse.engine.places import check_places
from sb3_sparse.errors import CorruptStateError, UnsupportedError, check_choice
from sb3_sparse.policies.arguments import arguments_of, import_classes
from sb3_sparse.policies.build import build_networks
from sb3_sparse.policies.compiled import names_in, plain_names
from sb3_sparse.policies.config import SparsityConfig
from sb3_sparse.policies.extractors import choose_extractor, copied_modules
from sb3_sparse.policies.fast_predict import FastPredict
from sb3_sparse.policies.modules import WHOLE_POLICY, copied
from sb3_sparse.policies.report import SparsityReport, build_report
from sb3_sparse.policies.spec import NetworkSpec
from sb3_sparse.policies.storage import may_be_sparse
from sb3_sparse.policies.vectors import DenseVectors

Sparse = TypeVar("Sparse", bound="BaseSparsePolicy")


class BaseSparsePolicy(DenseVectors, FastPredict):
    """Base class of sparse policies, to be put before a policy class of SB3.

    A subclass declares where its networks are; this class makes them sparse and keeps them so.

    Example::

        from sb3_sparse import SAC, BaseSparsePolicy

        model = SAC("SparsePolicy", "Pendulum-v1", policy_kwargs=dict(sparsity=0.9))
        assert isinstance(model.policy, BaseSparsePolicy)
        print(model.policy.sparsity_report())

    :param observation_space: as in SB3
    :param action_space: as in SB3
    :param lr_schedule: as in SB3
    :param kwargs: fields of :class:`~sb3_sparse.policies.config.SparsityConfig`, of which
        ``sparsity`` is required, and SB3's policy arguments; ``features_extractor_class``,
        ``optimizer_class`` and ``activation_fn`` may also be dotted paths, e.g.
        ``"torch.nn.ReLU"``
    :raises ConfigError: for a value that is not allowed
    :raises UnsupportedError: for layers or observations that cannot be trained sparsely
    :raises MissingKernels: for ``compute="sparse"`` without compiled kernels

    Source: arXiv:2206.10369.
    """

    networks: ClassVar[Mapping[str, NetworkSpec]]
    """Where the modules of each network are, by the network's name."""
    acting: ClassVar[tuple[str, ...]]
    """Names of the modules that turn an observation into an action: the features extractor, then
    those of the network."""
    acting_quantiles: ClassVar[str] = ""
    """Attribute with the number of quantiles for each action, of whose mean the policy takes the
    best; empty: it has none."""
    estimate: ClassVar[str] = ""
    """What estimates the return beside the action: the ``"output"`` of :attr:`valuing`; the
    ``"largest"`` score of an action; the ``"min"`` or the ``"mean"`` over critics of the
    observation and the action; empty: nothing."""
    valuing: ClassVar[tuple[str, ...]] = ()
    """Names of the modules that estimate the return, if those of :attr:`acting` do not: the
    features extractor, then those of the network, or the module with the critics."""
    action_spaces: ClassVar[tuple[type[spaces.Space[Any]], ...]] = (
        spaces.Box,
        spaces.Discrete,
        spaces.MultiDiscrete,
        spaces.MultiBinary,
    )
    """Kinds of action space that the policy supports."""
    functional_gradients: ClassVar[bool] = False
    """Whether an algorithm with this policy calls ``torch.autograd.grad``."""
    extractor_class: ClassVar[type[BaseFeaturesExtractor] | None] = None
    """Default features extractor; None: it depends on the observation space."""

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule | None = None,
        **kwargs: Any,
    ) -> None:
        if lr_schedule is None:
            raise UnsupportedError(
                f"{type(self).__name__} got no learning-rate schedule. Algorithms that learn "
                "without gradients, such as ARS, have no sparse policy; "
                "sb3_sparse.supported_algorithms() lists those that have one"
            )
        known = sorted(arguments_of(type(self), BaseSparsePolicy))
        for name in kwargs:
            check_choice(f"argument of {type(self).__name__}", name, known)
        config = SparsityConfig.pop_from(kwargs)
        import_classes(kwargs)
        weight_decay = check_weight_decay(config.weight_decay, kwargs.get("optimizer_kwargs"))
        if "features_extractor_class" not in kwargs:
            kwargs["features_extractor_class"] = self.extractor_class or choose_extractor(
                observation_space, kwargs.get("normalize_images", True)
            )
        seed = config.seed()  # before SB3 draws weights
        super().__init__(observation_space, action_space, lr_schedule, **kwargs)
        self.sparsity_config = config
        networks = build_networks(self, self.networks, config, seed, self._initial_gain)
        for network in networks:
            prefer_fused(network.optimizer)
        layers = [layer for network in networks for layer in network.layers]
        allowed = may_be_sparse(self, layers, asked_for=config.compute == "sparse")
        self.sparse = Controller(
            networks,
            seed,
            self.functional_gradients,
            weight_decay,
            AutoCompute(allowed) if config.compute == "auto" else None,
        )
        self.sparse.choose_storage(self)
        if config.compute == "sparse":
            self.sparse.to_sparse(self, allowed)
        if not all(layer.full and layer.final_nnz == layer.size for layer in self.sparse.layers):
            self.use_kernels()  # without zeros it computes what stock SB3 does, to the bit
        self.sparse.attach()

    def __deepcopy__(self: Sparse, memo: dict[Any, Any]) -> Sparse:
        memo[WHOLE_POLICY] = True
        twin = copied(self, memo)
        twin.sparse.attach()
        return twin

    def _apply(self, fn: Any, recurse: bool = True) -> Any:
        sparse = vars(self).get("sparse")  # SB3 moves modules before the policy is complete
        if sparse is not None and any(layer.is_sparse for layer in sparse.layers):
            try:
                check_conversion(fn)  # before anything changes
            except UnsupportedError:
                if self.sparsity_config.compute != "auto":
                    raise
                sparse.to_masked(self)  # to move to a GPU, for instance
        return super()._apply(fn, recurse)  # type: ignore[no-untyped-call]

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self.sparse.attach()  # hooks are not copied

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """As in SB3, with copies of the modules in ``features_extractor_kwargs``.

        So each extractor has its own, and the user's modules stay as they were.
        """
        given = self.features_extractor_kwargs
        self.features_extractor_kwargs = copied_modules(given)
        try:
            return super().make_features_extractor()
        finally:
            self.features_extractor_kwargs = given

    def use_kernels(self) -> None:
        """Compute in the kernels from now on, where they can."""

    def _initial_gain(self, layer_name: str) -> float:
        """Gain with which SB3 initialises the layer, relative to its default."""
        return 1.0

    def sparsity_report(self) -> SparsityReport:
        """Every layer's shape, nnz, density and FLOPs; ``print`` it for a table.

        :raises UnsupportedError: if a sparse layer was replaced by another module
        """
        check_places(self, self.sparse.layers)
        self.sparse.enforce()
        return build_report(self, self.sparse.networks)

    def set_training_mode(self, mode: bool) -> None:
        """As in SB3. Every ``train()`` calls it first, so a round of training begins here."""
        self._switch(mode)
        if mode:
            self.sparse.begin_training(self)
        else:
            self.sparse.enforce_if_written()  # users may have written to weights

    def _switch(self, mode: bool) -> bool:
        same = super()._switch(mode)
        if not same:
            check_places(self, self.sparse.layers)
        return same

    def load_from_vector(self, vector: np.ndarray[Any, Any]) -> None:
        super().load_from_vector(vector)
        for layer in self.sparse.layers:
            layer.settle_targets(soft=False)

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """As in torch; the weights of a dense policy, and of its target networks, are masked."""
        state_dict = plain_names(state_dict)
        for layer in self.sparse.layers:  # before anything is loaded
            mask = state_dict.get(f"{layer.name}.weight_mask")
            if mask is not None:
                layer.check_mask(mask)
        named = names_in(self, state_dict)
        incompatible = super().load_state_dict(named, strict=strict, assign=assign)
        if not any(key.endswith(".weight_mask") for key in state_dict):
            for layer in self.sparse.layers:
                layer.mask_targets()
        self.sparse.choose_storage(self)  # pruning may have made layers sparse
        return incompatible

    def get_extra_state(self) -> th.Tensor:
        """Mask seed, then clock and number of mask updates of each network, then a 0; int64.

        Older files have a minibatch size in place of the 0, which is ignored.
        """
        numbers = [self.sparse.seed]
        for network in self.sparse.networks:
            numbers += [network.clock, network.mask_updates]
        numbers.append(0)
        return th.tensor(numbers, dtype=th.int64)

    def set_extra_state(self, state: th.Tensor) -> None:
        """Restore what :meth:`get_extra_state` returned.

        :raises CorruptStateError: if it does not belong to this policy
        """
        networks = self.sparse.networks
        expected = 2 + 2 * len(networks)
        if (
            not isinstance(state, th.Tensor)
            or state.shape != (expected,)
            or bool((state < 0).any())
        ):
            raise CorruptStateError(
                f"the saved sparsity state must be {expected} numbers, 0 or more (seed, clock and "
                f"updates of {', '.join(n.name for n in networks)}, and a 0), got {state!r}; the "
                "file is damaged or belongs to a policy of another kind"
            )
        seed, *numbers, _ = state.tolist()
        self.sparse.seed = int(seed)
        for network, clock, updates in zip(networks, numbers[::2], numbers[1::2], strict=True):
            network.clock, network.mask_updates = int(clock), int(updates)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        config = self.sparsity_config
        dense_layers, weight_decay = list(config.dense_layers), self.sparse.weight_decay
        data.update(vars(config), dense_layers=dense_layers, weight_decay=weight_decay)
        if hasattr(self, "share_features_extractor"):  # SB3 forgets it for some of its policies
            data["share_features_extractor"] = self.share_features_extractor
        return data


def _with_sparse_arguments(own: inspect.Signature) -> inspect.Signature:
    """The signature with the fields of the config by name, before ``**kwargs``.

    ``help()`` shows it, and :func:`arguments_of` reads it.
    """
    *first, kwargs = own.parameters.values()
    sparse = [
        one.replace(kind=one.KEYWORD_ONLY)
        for one in inspect.signature(SparsityConfig).parameters.values()
    ]
    return own.replace(parameters=[*first, *sparse, kwargs])


_init: Any = BaseSparsePolicy.__init__
_init.__signature__ = _with_sparse_arguments(inspect.signature(_init))
