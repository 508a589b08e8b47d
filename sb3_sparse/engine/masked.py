"""Masked storage: the dense weight, 0 where inactive, and a mask."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_sparse.engine.gradients import GradientMask
from sb3_sparse.engine.layer import MASK_KEY
from sb3_sparse.engine.masked_gradients import AccumulatedGradient, FunctionalGradient, follow_mask
from sb3_sparse.engine.moments import clear_moments, moments_of
from sb3_sparse.engine.native.library import library, readable, why_missing
from sb3_sparse.engine.prunable import Prunable
from sb3_sparse.engine.storage import LayerStorage

FLOAT_MASK_KEY = "weight_mask_float"


def _ignore_mask_key(
    module: nn.Module, state_dict: dict[str, Any], prefix: str, *_: object
) -> None:
    """Pre-load hook of a target layer: drop its entry for a mask, which it does not have."""
    state_dict.pop(prefix + MASK_KEY, None)


def clear(weight: th.Tensor, mask: th.Tensor) -> None:
    """Set a weight to 0 where its mask is 0.

    Torch does not count this write, so an existing graph, perhaps in another thread, stays valid.
    """
    if why_missing() is None and readable(weight) and readable(mask):
        library().sb3_sparse_clear(weight.data_ptr(), mask.data_ptr(), weight.numel())
    else:
        weight.data.mul_(mask)


class MaskedStorage(LayerStorage):
    """Keeps a layer as its dense weight, 0 where inactive, and a boolean mask.

    The mask is the module's buffer ``weight_mask`` and so part of its state_dict. Gradients are
    multiplied by a float copy, which is not. Loading a state_dict, at any level, masks the weight
    again.

    :param name: dotted name within the policy
    :param module: the Linear or Conv layer; it stays in place
    """

    is_sparse = False

    def __init__(self, name: str, module: Prunable) -> None:
        super().__init__(name, module, tuple(module.weight.shape))
        self.targets: list[Prunable] = []
        self._connections = object()
        self._seen: tuple[int, int] | None = None
        ones = th.ones_like(module.weight, requires_grad=False)
        module.register_buffer(MASK_KEY, ones.bool())
        module.register_buffer(FLOAT_MASK_KEY, ones, persistent=False)
        self._hooks: list[Any] = [
            module.register_load_state_dict_pre_hook(self._before_load),  # type: ignore[no-untyped-call]
            module.register_load_state_dict_post_hook(self._after_load),  # type: ignore[no-untyped-call]
            module.register_state_dict_pre_hook(self._before_save),  # type: ignore[no-untyped-call]
        ]

    @staticmethod
    def of(module: nn.Module) -> MaskedStorage | None:
        """Find the masked storage of a module; None if it has none."""
        for hook in module._load_state_dict_post_hooks.values():
            layer = getattr(hook, "__self__", None)
            if isinstance(layer, MaskedStorage) and layer.module is module:
                return layer
        return None

    @staticmethod
    def below(root: nn.Module) -> Iterator[MaskedStorage]:
        """Find the masked storage of a module and all modules in it, without targets."""
        return filter(None, map(MaskedStorage.of, root.modules()))

    @property
    def float_mask(self) -> th.Tensor:
        """1.0 where active, else 0.0, in the weight's shape and on its device."""
        # This is read for every gradient, so it bypasses nn.Module's attribute lookup.
        mask = self.module._buffers[FLOAT_MASK_KEY]
        assert mask is not None
        return mask

    def mask(self) -> NDArray[np.bool_]:
        mask = self.module.get_buffer(MASK_KEY)
        return np.array(mask.cpu().numpy().ravel(), dtype=np.bool_)

    def dense(self) -> NDArray[np.float32]:
        array: NDArray[np.float32] = self.weight.detach().cpu().numpy().ravel()
        return array

    def add_target(self, module: Prunable) -> None:
        """Make ``module`` a target copy of this layer, with the same weights."""
        self.targets.append(module)
        self._hooks += [
            module.register_load_state_dict_pre_hook(_ignore_mask_key),  # type: ignore[no-untyped-call]
            module.register_load_state_dict_post_hook(self._after_target_load),  # type: ignore[no-untyped-call]
            module.register_state_dict_pre_hook(self._before_target_save),  # type: ignore[no-untyped-call]
        ]
        self.sync_targets()

    def sync_targets(self) -> None:
        """Copy the weights into every target."""
        with th.no_grad():
            for target in self.targets:
                target.weight.copy_(self.weight)

    def mask_targets(self) -> None:
        for target in self.targets:
            clear(target.weight, self.float_mask)

    def set_mask(self, mask: NDArray[np.bool_]) -> None:
        """Replace the mask, and set inactive weights to 0.

        :param mask: shape ``(size,)`` or the weight's shape
        """
        buffer = self.module.get_buffer(MASK_KEY)
        buffer.copy_(th.from_numpy(np.ascontiguousarray(mask)).view(self.shape))
        self.apply_mask()

    def mask_gradient(self) -> None:
        if self.weight.grad is not None and not self.full:
            self.weight.grad.mul_(self.float_mask)

    def write(self, dense: th.Tensor) -> None:
        with th.no_grad():
            self.weight.copy_(dense.view(self.shape))
        self.remask()

    def _dense_targets(self) -> Iterable[NDArray[np.float32]]:
        return (target.weight.detach().cpu().numpy() for target in self.targets)

    def apply_mask(self) -> None:
        """Bring the float mask, nnz and the weight in line with the boolean mask."""
        mask = self.module.get_buffer(MASK_KEY)
        self.float_mask.copy_(mask)
        self.nnz = int(mask.sum())
        self._connections = object()
        with th.no_grad():
            self.weight.mul_(self.float_mask)

    def remask(self) -> None:
        if not self.full:
            clear(self.weight, self.float_mask)
            self.accept_writes()

    def remask_if_written(self) -> None:
        weight = self.weight
        if (weight._version, weight.data_ptr()) != self._seen:
            self.remask()

    def accept_writes(self) -> None:
        weight = self.weight
        self._seen = weight._version, weight.data_ptr()

    def _gradient_mask(self, functional: bool, capturing: Callable[[], bool]) -> GradientMask:
        return (FunctionalGradient if functional else AccumulatedGradient)(self, capturing)

    def settle_moments(self, optimizers: Sequence[th.optim.Optimizer]) -> None:
        for state, key, value in moments_of(optimizers, self.weight):
            if value.shape == self.weight.shape:
                value.mul_(self.float_mask)
            elif value.shape == (self.nnz,):  # saved by hand from a sparse layer
                state[key] = th.zeros_like(self.weight)
                state[key][self.module.get_buffer(MASK_KEY)] = value
        self.moments_stale = False

    def clear_moments(
        self, where: NDArray[np.bool_], optimizers: Sequence[th.optim.Optimizer]
    ) -> None:
        if self.moments_stale:
            self.settle_moments(optimizers)
        clear_moments(self.weight, where, optimizers)

    @property
    def connections(self) -> object:
        return self._connections

    def follow(self, optimizer: th.optim.Optimizer, since: object) -> None:
        if since is not self._connections:
            for _, _, value in moments_of([optimizer], self.weight):
                if value.shape == self.weight.shape:
                    value.mul_(self.float_mask)

    def saved_moment(self, moment: th.Tensor) -> th.Tensor:
        return moment

    def _move(
        self,
        mask: NDArray[np.bool_],
        optimizers: Sequence[th.optim.Optimizer],
        soft_targets: bool,
        dense_grad: th.Tensor | None,
    ) -> None:
        before = self.float_mask.clone()
        self.set_mask(mask)
        kept = before * self.float_mask
        for _, _, value in moments_of(optimizers, self.weight):
            if value.shape == self.weight.shape:
                value.mul_(kept)
        if soft_targets:
            self.mask_targets()
        follow_mask(self.weight.grad, dense_grad, before, self.float_mask)

    def release(self) -> None:
        """Remove hooks and masks from the modules, before another storage takes over."""
        for hook in self._hooks:
            hook.remove()
        del self.module._buffers[MASK_KEY], self.module._buffers[FLOAT_MASK_KEY]

    def _after_load(self, module: nn.Module, incompatible_keys: object) -> None:
        mask = self.module.get_buffer(MASK_KEY)
        moved = not th.equal(self.float_mask, mask.to(self.float_mask.dtype))
        self.apply_mask()
        self.moments_stale = True
        if moved:
            self.mask_targets()

    def _before_target_save(self, module: nn.Module, prefix: str, keep_vars: bool) -> None:
        self.settle_targets(soft=False)

    def _before_save(self, module: nn.Module, prefix: str, keep_vars: bool) -> None:
        self.remask()
