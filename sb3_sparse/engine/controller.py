"""Moves the masks of one policy by hooks on its gradients and optimizers."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from functools import partial
from itertools import chain
from typing import Any

import torch as th
from torch import nn
from torch.utils.hooks import RemovableHandle

from sb3_sparse.engine.auto import AutoCompute
from sb3_sparse.engine.foreign import watch
from sb3_sparse.engine.hooks import Hooks
from sb3_sparse.engine.moments import save_moments
from sb3_sparse.engine.network import SparseNetwork
from sb3_sparse.engine.optimizers import acts_elementwise, add_weight_decay, keep_implementation
from sb3_sparse.engine.plan import Plan, warn_of_no_plan
from sb3_sparse.engine.plans import Plans
from sb3_sparse.engine.sequential import chain_up
from sb3_sparse.engine.storage import LayerStorage, check_masked


class Controller:
    """Keeps the gradients and masks of a policy's sparse networks.

    A hook masks each gradient on arrival, before it is clipped. Before each step of an optimizer,
    another hook advances the clocks of the networks that it owns and moves their masks where an
    update is due; the step then uses gradients under the new mask.

    Copies and pickles of a controller have no plans, and no hooks until :meth:`attach` is called.

    :param networks: the sparse networks
    :param seed: mask seed, not negative
    :param functional_gradients: whether the algorithm may use ``torch.autograd.grad``
    :param weight_decay: coupled L2 coefficient, added to the gradient of every weight
    :param auto: chooses the storage of layers; None keeps it
    """

    def __init__(
        self,
        networks: list[SparseNetwork],
        seed: int,
        functional_gradients: bool,
        weight_decay: float = 0.0,
        auto: AutoCompute | None = None,
    ) -> None:
        self.networks = networks
        self.seed = seed
        self.weight_decay = weight_decay
        self.functional_gradients = functional_gradients
        self._auto = auto
        self._in_force: Callable[[], bool] = bool
        self.progress = 0.0
        self.soft_targets = False
        """Whether targets follow a mask at once."""
        self._gradient_hooks, self._optimizer_hooks = Hooks(), Hooks()
        self._dense = not any(network.sparse_layers for network in networks)  # for good
        self._warned = self._dense

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_in_force": bool}

    @property
    def layers(self) -> Iterable[LayerStorage]:
        """Every layer within a budget, once."""
        return (layer for network in self.networks for layer in network.layers)

    @property
    def sparsity(self) -> float:
        """Currently removed fraction of all connections within the budgets."""
        return 1.0 - sum(n.nnz for n in self.networks) / sum(n.size for n in self.networks)

    @property
    def has_plans(self) -> bool:
        """Whether a training has started to move masks, and has not ended."""
        return any(network.plan is not None for network in self.networks)

    @property
    def optimizers(self) -> list[th.optim.Optimizer]:
        """Every optimizer that owns a network, once."""
        return list({id(n.optimizer): n.optimizer for n in self.networks}.values())

    def _owned_by(self, optimizer: th.optim.Optimizer) -> list[SparseNetwork]:
        return [network for network in self.networks if network.optimizer is optimizer]

    def attach(self) -> None:
        """Register the hooks, unless these very weights and optimizers have them already."""
        changed = self._attach_to_gradients()
        if self._optimizer_hooks.attach(self.optimizers, self._hook_optimizers) or changed:
            watch(self)

    def _attach_to_gradients(self) -> bool:
        """Register the hooks on gradients alone; tell whether they were missing."""
        layers = _sparse_layers(self.networks)
        weights = [layer.weight for layer in layers if not layer.frozen]
        return self._gradient_hooks.attach(weights, self._hook_gradients)

    def _hook_gradients(self) -> list[RemovableHandle]:
        functional = self.functional_gradients
        for layer in self.layers:
            layer.gradient_mask = None
        return [
            layer.hook_gradient(functional, partial(self._capturing, network))
            for network in self.networks
            for layer in network.sparse_layers
            if not layer.frozen
        ]

    def _hook_optimizers(self) -> list[RemovableHandle]:
        handles: list[RemovableHandle] = []
        for optimizer in self.optimizers:
            handles += [
                optimizer.register_step_pre_hook(self._before_step),
                optimizer.register_load_state_dict_pre_hook(keep_implementation),
                optimizer.register_load_state_dict_post_hook(self._after_load),
                optimizer.register_state_dict_pre_hook(self._settle_moments),
                optimizer.register_state_dict_post_hook(self._saved_form),
            ]
            after = self._accept_writes
            if not acts_elementwise(optimizer):
                owned = [network.layers for network in self._owned_by(optimizer)]
                check_masked(optimizer, chain.from_iterable(owned))
                after = self._after_step
            handles.append(optimizer.register_step_post_hook(after))
        return handles

    def to_sparse(self, root: nn.Module, names: Container[str] | None = None) -> None:
        """Move layers that can have it to sparse storage, in place.

        :param root: the policy, whose ``Sequential`` modules then run them as chains
        :param names: names of the layers; None: all
        :raises UnsupportedError: if their optimizer needs dense weights
        """
        for network in self.networks:
            network.to_sparse(names, self.optimizers)
        self._hook_anew(root)

    def choose_storage(self, root: nn.Module) -> None:
        """Apply the rule of ``compute="auto"`` again if connections have been removed since.

        :param root: the policy
        """
        auto = self._auto
        if auto and (chosen := auto.choose(root, list(self.layers), self.optimizers)):
            self.to_sparse(root, chosen)

    def to_masked(self, root: nn.Module) -> None:
        """Move every layer to masked storage, in place.

        :param root: the policy
        """
        for network in self.networks:
            network.to_masked(self.optimizers)
        self._auto = None
        self._hook_anew(root)

    def _hook_anew(self, root: nn.Module) -> None:
        chain_up(root)
        self._gradient_hooks.remove()
        self._optimizer_hooks.remove()
        self.attach()

    def begin_training(self, root: nn.Module) -> None:
        """Prepare the policy ``root`` for a round of gradient steps."""
        self.attach()
        self.choose_storage(root)
        if not self._in_force():
            self.drop_plans()  # left from an interrupted training
        for layer in _sparse_layers(self.networks):
            if layer.gradient_mask is not None:
                layer.gradient_mask.dense_grad = None
            layer.remask()
            layer.settle_targets(self.soft_targets)

    def enforce(self) -> None:
        """Set inactive weights to 0 in case they have been written."""
        for layer in _sparse_layers(self.networks):
            layer.remask()

    def enforce_if_written(self) -> None:
        """As :meth:`enforce`, but only for weights that torch has seen written since."""
        for layer in _sparse_layers(self.networks):
            layer.remask_if_written()

    def start(self, plans: Plans, soft_targets: bool, in_force: Callable[[], bool]) -> None:
        """Start moving masks.

        :param plans: the plan of each network
        :param soft_targets: whether targets follow the mask at once (Polyak averaging), or at the
            next hard copy
        :param in_force: tells whether the training that the plans were made for is still running
        """
        for network in self.networks:
            network.start(plans[network.name])
        self._in_force = in_force
        self.soft_targets = soft_targets

    def stop(self) -> None:
        """Carry out the updates that are still due, and freeze the masks."""
        self.flush()
        for network in self.networks:
            if network.must_finish(self.progress):
                self._move(network, {})
        self.drop_plans()

    def drop_plans(self) -> None:
        """Freeze the masks as they are."""
        for network in self.networks:
            network.plan = None

    def flush(self) -> None:
        """Carry out updates that have waited for the end of the rollout."""
        for network in self.networks:
            if network.pending is not None and network.plan is not None:
                self._move(network, network.pending)
            network.pending = None

    def _capturing(self, network: SparseNetwork) -> bool:
        if self.functional_gradients:  # a rollout's actor gradient comes before its steps
            return network.plan is not None and network.plan.wants_gradients
        return network.wants_gradients(self.progress)

    def _before_step(self, optimizer: th.optim.Optimizer, args: object, kwargs: object) -> None:
        if not self._dense:
            self._attach_to_gradients()  # a layer may have been frozen until now
            self._settle_moments(optimizer)
        for network in self._owned_by(optimizer):
            network.clock += 1
            if network.plan is None and not self._warned and network.denser:
                self._warned = True
                warn_of_no_plan(self.sparsity)
            for layer in network.sparse_layers:
                layer.remask_if_written()
                layer.mask_gradient()  # which others may have written after our hooks
            if network.plan is not None:
                self._update_if_due(network, network.plan)
            if self.weight_decay:
                add_weight_decay(network.weights, self.weight_decay)

    def _accept_writes(self, optimizer: th.optim.Optimizer, args: object, kwargs: object) -> None:
        """Runs after the step of an optimizer that keeps weights at 0 whose gradient is 0."""
        for layer in _sparse_layers(self._owned_by(optimizer)):
            layer.accept_writes()

    def _after_step(self, optimizer: th.optim.Optimizer, args: object, kwargs: object) -> None:
        """Runs after the step of an optimizer that writes to inactive weights."""
        for layer in _sparse_layers(self._owned_by(optimizer)):
            layer.remask()

    def needs_torch(self, optimizer: th.optim.Optimizer) -> bool:
        """Whether torch must take the optimizer's next step, e.g. because masks move at it."""
        return any(
            network.due(network.clock + 1, self.progress)
            or (network.plan is None and not self._warned and network.denser)
            or any(layer.moments_stale for layer in network.layers)
            for network in self._owned_by(optimizer)
        )

    def wants_gradients(self, optimizer: th.optim.Optimizer) -> bool:
        """Whether the optimizer's next step needs dense gradients."""
        owned = self._owned_by(optimizer)
        return any(network.wants_gradients(self.progress) for network in owned)

    def count_step(self, optimizer: th.optim.Optimizer) -> None:
        """Count a step that was taken in the optimizer's place."""
        for network in self._owned_by(optimizer):
            network.clock += 1

    def _update_if_due(self, network: SparseNetwork, plan: Plan) -> None:
        gradients = network.take_gradients()
        if network.due(network.clock, self.progress):
            network.updates_due += 1
            computed = {name: None if g is None else g() for name, g in gradients.items()}
            if plan.update_on == "step":
                self._move(network, computed)
            else:
                network.pending = computed

    def _after_load(self, optimizer: th.optim.Optimizer) -> None:
        for layer in self.layers:
            layer.moments_stale = True

    def _settle_moments(self, optimizer: th.optim.Optimizer) -> None:
        for layer in self.layers:
            if layer.moments_stale:  # a shared extractor may have moments in several
                layer.settle_moments(self.optimizers)

    def _saved_form(self, optimizer: th.optim.Optimizer, state_dict: dict[str, Any]) -> None:
        save_moments(optimizer, state_dict, self.layers)

    def _move(self, network: SparseNetwork, gradients: dict[str, th.Tensor | None]) -> None:
        network.move(gradients, self.progress, self.seed, self.optimizers, self.soft_targets)


def _sparse_layers(networks: Iterable[SparseNetwork]) -> Iterable[LayerStorage]:
    return chain.from_iterable(network.sparse_layers for network in networks)
