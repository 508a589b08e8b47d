"""One layer's connections, behind an interface that hides how they are stored."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_sparse.engine.kernels import Kernel
from sb3_sparse.errors import TopologyError
from sb3_sparse.topology import Exchange

MASK_KEY = "weight_mask"
FLOAT_MASK_KEY = "weight_mask_float"


def _ignore_mask_key(
    module: nn.Module, state_dict: dict[str, Any], prefix: str, *_: object
) -> None:
    """Pre-load hook of a target layer, which has no mask of its own."""
    state_dict.pop(prefix + MASK_KEY, None)


class MaskedLayer:
    """A layer stored as its dense weight, 0 where inactive, and a boolean mask.

    The mask is the buffer ``weight_mask`` of the module and so rides in its state_dict; a float
    copy that does not is what gradients are multiplied with. Whenever a state_dict is loaded, at
    any level, the weight is masked again.

    :param name: dotted name within the policy
    :param module: the Linear or Conv layer; it stays in place
    """

    def __init__(self, name: str, module: Kernel) -> None:
        self.name = name
        self.module = module
        self.shape = tuple(module.weight.shape)
        self.size = module.weight.numel()
        self.nnz = self.size
        self.initial_nnz = self.size
        self.final_nnz = self.size
        self.targets: list[Kernel] = []
        self.moments_stale = False
        ones = th.ones_like(module.weight, requires_grad=False)
        module.register_buffer(MASK_KEY, ones.bool())
        module.register_buffer(FLOAT_MASK_KEY, ones, persistent=False)
        module.register_load_state_dict_post_hook(self._after_load)  # type: ignore[no-untyped-call]

    @property
    def weight(self) -> nn.Parameter:
        """The parameter that the optimizer moves."""
        weight = self.module.weight
        assert isinstance(weight, nn.Parameter)
        return weight

    @property
    def full(self) -> bool:
        """Whether every connection is active."""
        return self.nnz == self.size

    @property
    def float_mask(self) -> th.Tensor:
        """1.0 where active, else 0.0, in the weight's shape and on its device."""
        # Not through attribute lookup of nn.Module: this is read for every gradient.
        mask = self.module._buffers[FLOAT_MASK_KEY]
        assert mask is not None
        return mask

    def mask(self) -> NDArray[np.bool_]:
        """True where a connection is active, shape ``(size,)``; a copy."""
        mask = self.module.get_buffer(MASK_KEY)
        return np.array(mask.cpu().numpy().ravel(), dtype=np.bool_)

    def dense(self) -> NDArray[np.float32]:
        """The weights, 0 where inactive, shape ``(size,)``."""
        array: NDArray[np.float32] = self.weight.detach().cpu().numpy().ravel()
        return array

    def add_target(self, module: Kernel) -> None:
        """Make ``module`` a target copy of this layer; it takes the weights that the layer has."""
        self.targets.append(module)
        module.register_load_state_dict_pre_hook(_ignore_mask_key)  # type: ignore[no-untyped-call]
        self.sync_targets()

    def sync_targets(self) -> None:
        """Copy the weights into every target."""
        with th.no_grad():
            for target in self.targets:
                target.weight.copy_(self.weight)

    def mask_targets(self) -> None:
        """Set to 0 what the mask has inactive in every target."""
        with th.no_grad():
            for target in self.targets:
                target.weight.mul_(self.float_mask)

    def set_mask(self, mask: NDArray[np.bool_]) -> None:
        """Replace the mask and set what it has inactive to 0.

        :param mask: shape ``(size,)`` or the weight's shape
        """
        buffer = self.module.get_buffer(MASK_KEY)
        buffer.copy_(th.from_numpy(np.ascontiguousarray(mask)).view(self.shape))
        self.apply_mask()

    def set_weights(self, weights: NDArray[np.float32]) -> None:
        """Replace the active weights; what is inactive stays 0.

        :param weights: shape ``(size,)`` or the weight's shape
        """
        with th.no_grad():
            self.weight.copy_(th.from_numpy(np.ascontiguousarray(weights)).view(self.shape))
        self.apply_mask()

    def apply_mask(self) -> None:
        """Bring float mask, nnz and weight in line with the boolean mask."""
        mask = self.module.get_buffer(MASK_KEY)
        self.float_mask.copy_(mask)
        self.nnz = int(mask.sum())
        with th.no_grad():
            self.weight.mul_(self.float_mask)

    def drop_grow(self, exchange: Exchange) -> th.Tensor:
        """Move connections. Grown ones start at 0.

        :param exchange: what to drop (must be active) and to grow (must be inactive)
        :return: 1.0 where a connection was active before and still is, in the weight's shape
        :raises TopologyError: if the exchange does not fit the mask or would leave it empty
        """
        mask = self.mask()
        dropped, grown = exchange.dropped, exchange.grown
        after = mask.copy()
        after[dropped] = False
        after[grown] = True
        moved = np.concatenate([dropped, grown])
        if (
            not mask[dropped].all()
            or mask[grown].any()
            or np.unique(moved).size != moved.size
            or not after.any()
        ):
            raise TopologyError(
                f"the exchange for {self.name} drops {dropped.size} and grows {grown.size} of "
                f"{self.nnz} connections, but some of the dropped are not active, some of the "
                "grown are, an index stands twice, or no connection would be left"
            )
        before = self.float_mask.clone()
        self.set_mask(after)
        return before.mul_(self.float_mask)

    def _after_load(self, module: nn.Module, incompatible_keys: object) -> None:
        self.apply_mask()
        self.moments_stale = True
