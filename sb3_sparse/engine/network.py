"""A network: layers that share one budget, and the clock of the optimizer that owns them."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from typing import Any

import torch as th
from torch import nn

from sb3_sparse.engine.gradients import DenseGradient
from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.engine.plan import Plan
from sb3_sparse.engine.prunable import Prunable
from sb3_sparse.engine.sparse import SparseStorage, to_sparse
from sb3_sparse.engine.storage import LayerStorage
from sb3_sparse.sparsity.distributions import active_counts
from sb3_sparse.sparsity.initialisation import random_mask, sparsity_aware_weights


class SparseNetwork:
    """Owns the layers of one network.

    :param name: e.g. ``"actor"``
    :param owner: module whose attribute ``optimizer`` moves the network
    :param prunable: layers within the budget, with their dotted names
    :param dense_layers: layers left dense, outside the budget
    """

    def __init__(
        self,
        name: str,
        owner: nn.Module,
        prunable: Sequence[tuple[str, Prunable]],
        dense_layers: Sequence[tuple[str, Prunable]] = (),
    ) -> None:
        self.name = name
        self.owner = owner
        self.layers: list[LayerStorage] = [
            MaskedStorage(layer_name, module) for layer_name, module in prunable
        ]
        self.dense_layers = list(dense_layers)
        self.plan: Plan | None = None
        """When masks move, and how; None: they do not, and no callback watches over them."""
        self.updates_due = 0
        """Updates due since the plan was made."""
        self.clock = 0
        """Gradient steps begun by the owning optimizer."""
        self.mask_updates = 0
        """Updates so far in which a connection moved."""
        self.churn = 0.0
        """Share of the active connections that the last update dropped."""
        self.pending: dict[str, th.Tensor | None] | None = None
        """Dense gradients of an update that waits for the end of the rollout, by layer name."""

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "plan": None}  # a copy is trained by nobody yet

    @property
    def optimizer(self) -> th.optim.Optimizer:
        """The optimizer that owns the network now."""
        optimizer = self.owner.optimizer
        assert isinstance(optimizer, th.optim.Optimizer)
        return optimizer

    @property
    def weights(self) -> list[th.Tensor]:
        """Weights of all Linear and Conv layers, including those left dense."""
        dense = (module.weight for _, module in self.dense_layers)
        return [*(layer.weight for layer in self.layers), *dense]

    @property
    def sparse_layers(self) -> list[LayerStorage]:
        """Layers with connections that are inactive or may become so."""
        return [layer for layer in self.layers if not layer.always_full]

    @property
    def size(self) -> int:
        """Connections of the dense network, within the budget."""
        return sum(layer.size for layer in self.layers)

    @property
    def nnz(self) -> int:
        """Active connections, within the budget."""
        return sum(layer.nnz for layer in self.layers)

    @property
    def denser(self) -> bool:
        """Whether a layer has more connections than the requested sparsity allows."""
        return any(layer.nnz > layer.final_nnz and not layer.frozen for layer in self.layers)

    def initialise(
        self,
        sparsity: float,
        initial_sparsity: float,
        distribution: str,
        seed: int,
        gains: dict[str, float] | None,
    ) -> None:
        """Draw masks and, if asked, weights; a network that starts dense stays untouched.

        :param sparsity: sparsity at the end of training, in [0, 1)
        :param initial_sparsity: sparsity at the start, at most ``sparsity``
        :param distribution: a name of :mod:`sb3_sparse.sparsity.distributions`
        :param seed: mask seed
        :param gains: SB3's gain of each layer by name, to redraw the weights by their active fans;
            None keeps SB3's own weights, masked
        """
        shapes = [layer.shape for layer in self.layers]
        final = active_counts(shapes, sparsity, distribution)
        initial = active_counts(shapes, initial_sparsity, distribution)
        for layer, final_nnz, initial_nnz in zip(self.layers, final, initial, strict=True):
            layer.final_nnz = final_nnz
            layer.initial_nnz = max(initial_nnz, final_nnz)
            if initial_sparsity == 0.0:
                continue
            assert isinstance(layer, MaskedStorage)  # every network starts masked
            mask = random_mask(layer.shape, layer.initial_nnz, seed, layer.name)
            layer.set_mask(mask)
            if gains is not None:
                gain = gains[layer.name]
                weights = sparsity_aware_weights(mask, seed, layer.name, gain)
                layer.write(th.from_numpy(weights))

    def to_sparse(
        self, names: Container[str] | None, optimizers: Sequence[th.optim.Optimizer]
    ) -> None:
        """Move layers that can have it to sparse storage.

        :param names: names of the layers; None: all
        :param optimizers: optimizers whose moments follow
        """
        self.layers = [
            to_sparse(layer, optimizers) if names is None or layer.name in names else layer
            for layer in self.layers
        ]

    def to_masked(self, optimizers: Sequence[th.optim.Optimizer]) -> None:
        """Move every layer to masked storage.

        :param optimizers: optimizers whose moments follow
        """
        self.layers = [
            layer.to_masked(optimizers) if isinstance(layer, SparseStorage) else layer
            for layer in self.layers
        ]

    def start(self, plan: Plan) -> None:
        """Start moving masks by a plan."""
        self.plan = plan
        self.updates_due = 0
        self.pending = None  # left from an interrupted training

    def due(self, step: int, progress: float) -> bool:
        """Whether masks move at that gradient step.

        :param step: gradient step of the owning optimizer, from 1
        :param progress: environment steps done / planned
        """
        plan = self.plan
        return plan is not None and (plan.due(step, progress) or self.must_finish(progress))

    def must_finish(self, progress: float) -> bool:
        """Whether the plan has ended while the network is still too dense."""
        plan = self.plan
        return (
            plan is not None
            and plan.topology.reaches_final
            and progress >= plan.end
            and self.denser
        )

    def wants_gradients(self, progress: float) -> bool:
        """Whether the next gradient step needs dense gradients."""
        plan = self.plan
        return (
            plan is not None
            and plan.wants_gradients
            and ((self.clock + 1) % plan.update_interval == 0 or self.must_finish(progress))
        )

    def take_gradients(self) -> dict[str, DenseGradient | None]:
        """Take the dense gradients of the next step, by layer name."""
        hooked = ((layer.name, layer.gradient_mask) for layer in self.layers)
        return {name: gradient.take() for name, gradient in hooked if gradient is not None}

    def move(
        self,
        gradients: Mapping[str, th.Tensor | None],
        progress: float,
        seed: int,
        optimizers: Sequence[th.optim.Optimizer],
        soft_targets: bool,
    ) -> None:
        """Move the masks of all trained layers by the plan.

        :param gradients: dense gradients by layer name
        :param progress: environment steps done / planned
        :param seed: mask seed
        :param optimizers: optimizers whose moments follow
        :param soft_targets: whether targets follow at once
        """
        assert self.plan is not None
        method, at_once = self.plan.topology, self.plan.update_on == "step"
        update = self.plan.update_at(self.clock, progress, seed)
        nnz = self.nnz
        last = method.reaches_final and update.progress >= update.end  # nothing grows any more
        dropped = grown = 0
        for layer in self.layers:
            if layer.frozen:
                continue
            gradient = gradients.get(layer.name)
            dense_grad = None
            if method.needs_gradient and gradient is not None:
                dense_grad = gradient.detach().cpu().numpy().ravel()
            elif method.needs_gradient and not last:
                continue
            exchange = method.exchange(layer, update, dense_grad=dense_grad)
            if not exchange:
                continue
            layer.move(
                exchange,
                optimizers,
                soft_targets=soft_targets,
                dense_grad=gradient if at_once else None,
            )
            dropped += exchange.dropped.size
            grown += exchange.grown.size
        if dropped or grown:
            self.mask_updates += 1
            self.churn = dropped / nnz
