"""Base class of storages, which hide how a layer's connections are kept."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import Any, ClassVar

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn
from torch.utils.hooks import RemovableHandle

from sb3_sparse.engine.gradients import GradientMask
from sb3_sparse.engine.layer import MASK_KEY
from sb3_sparse.engine.prunable import Prunable, check_plain
from sb3_sparse.errors import CorruptStateError, TopologyError, UnsupportedError
from sb3_sparse.topology import Exchange


class LayerStorage(ABC):
    """Base class of storages: keeps the connections of one layer within a budget.

    :param name: dotted name within the policy
    :param module: the Linear or Conv layer; it stays in place
    :param shape: of the dense weight
    """

    is_sparse: ClassVar[bool]
    """Whether the layer stores and computes its active connections only."""
    targets: Sequence[Prunable]
    """The layer's copies in target networks."""

    def __init__(self, name: str, module: Prunable, shape: tuple[int, ...]) -> None:
        self.name = name
        self.module = module
        self.shape = shape
        self.size = int(np.prod(shape, dtype=np.int64))
        self.nnz = self.size
        self.initial_nnz = self.size
        self.final_nnz = self.size
        self.moments_stale = False
        """Whether an optimizer's moments may not fit the mask."""
        self.gradient_mask: GradientMask | None = None
        """The hook on the weight's gradient; None if there is none, as for frozen weights."""

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "gradient_mask": None}  # hooks are registered anew on a copy

    @property
    def weight(self) -> nn.Parameter:
        """The parameter that the optimizer moves."""
        weight = self.module._parameters.get("weight")
        if weight is None:
            check_plain(self.module, self.name)
        assert weight is not None
        return weight

    @property
    def full(self) -> bool:
        """Whether every connection is active."""
        return self.nnz == self.size

    @property
    def always_full(self) -> bool:
        """Whether every connection is active for good."""
        return self.nnz == self.size == self.final_nnz

    @property
    def frozen(self) -> bool:
        """Whether the weight is not trained, so that its connections do not move."""
        return not self.weight.requires_grad

    @abstractmethod
    def mask(self) -> NDArray[np.bool_]:
        """True where a connection is active, shape ``(size,)``; a copy."""

    @abstractmethod
    def dense(self) -> NDArray[np.float32]:
        """The weights, 0 where inactive, shape ``(size,)``."""

    @abstractmethod
    def mask_targets(self) -> None:
        """Set inactive weights of every target to 0."""

    @abstractmethod
    def remask(self) -> None:
        """Set inactive weights to 0, in case the weight has been written."""

    def remask_if_written(self) -> None:
        """As :meth:`remask`, but only if torch has counted a write since, which is cheap to check.

        Torch does not count writes through ``.data`` or NumPy.
        """
        self.remask()

    def accept_writes(self) -> None:
        """Note that the writes counted so far kept inactive weights at 0."""
        return None

    @abstractmethod
    def mask_gradient(self) -> None:
        """Set the gradient of inactive weights to 0, in case it has been written."""

    @abstractmethod
    def write(self, dense: th.Tensor) -> None:
        """Replace the active weights; inactive ones stay 0.

        :param dense: as many elements as the dense weight
        """

    def settle_targets(self, soft: bool) -> None:
        """Bring the targets in line with the mask.

        :param soft: whether targets follow the mask at once. A hard target may keep the connections
            of its last copy, but never more than the layer ever had.
        """
        most = max(self.nnz, self.initial_nnz)
        if soft or any(np.count_nonzero(dense) > most for dense in self._dense_targets()):
            self.mask_targets()

    @abstractmethod
    def _dense_targets(self) -> Iterable[NDArray[np.float32]]:
        """Return the dense weights of each target."""

    def check_mask(self, mask: th.Tensor) -> None:
        """Reject a saved mask of another sparsity.

        :param mask: as many elements as the dense weight, True where active
        :raises CorruptStateError: if it has fewer connections than the layer at the end of training
            or more than at its start
        """
        count = int(mask.count_nonzero())
        if not self.final_nnz <= count <= self.initial_nnz:
            raise CorruptStateError(
                f"the mask of {self.name} has {count} of {self.size} connections; a policy of this "
                f"sparsity has {self.final_nnz}"
                + (f" to {self.initial_nnz}" if self.initial_nnz > self.final_nnz else "")
                + ". Load a file of the same sparsity, or make the policy with that of the file"
            )

    def _before_load(
        self, module: nn.Module, state_dict: dict[str, Any], prefix: str, *_: object
    ) -> None:
        if (mask := state_dict.get(prefix + MASK_KEY)) is not None:
            self.check_mask(mask)

    def _after_target_load(self, module: nn.Module, incompatible_keys: object) -> None:
        self.settle_targets(soft=False)

    def hook_gradient(self, functional: bool, capturing: Callable[[], bool]) -> RemovableHandle:
        """Mask each gradient on arrival from now on.

        :param functional: whether the algorithm uses ``torch.autograd.grad``
        :param capturing: tells whether the next step needs the dense gradient
        """
        self.gradient_mask = self._gradient_mask(functional, capturing)
        return self.gradient_mask.attach()

    @abstractmethod
    def _gradient_mask(self, functional: bool, capturing: Callable[[], bool]) -> GradientMask: ...

    def note_gradient(self, dense_grad: th.Tensor) -> None:
        """Take the dense gradient of the next step from whatever has computed it."""
        if self.gradient_mask is not None:
            self.gradient_mask.dense_grad = lambda: dense_grad

    @abstractmethod
    def settle_moments(self, optimizers: Sequence[th.optim.Optimizer]) -> None:
        """Bring the optimizers' moments in line with mask and storage."""

    @abstractmethod
    def clear_moments(
        self, where: NDArray[np.bool_], optimizers: Sequence[th.optim.Optimizer]
    ) -> None:
        """Set the moments of some weights to 0.

        :param where: which weights, shape ``(size,)``
        """

    @property
    @abstractmethod
    def connections(self) -> object:
        """An object that is replaced whenever the mask or the storage changes."""

    @abstractmethod
    def follow(self, optimizer: th.optim.Optimizer, since: object) -> None:
        """Bring the moments of the user's own optimizer in line with mask and storage.

        :param since: :attr:`connections` at the last call
        :raises UnsupportedError: if the moments cannot follow a mask that has moved
        """

    @abstractmethod
    def saved_moment(self, moment: th.Tensor) -> th.Tensor:
        """Return a moment of the weight in the form that a state_dict has."""

    @abstractmethod
    def _move(
        self,
        mask: NDArray[np.bool_],
        optimizers: Sequence[th.optim.Optimizer],
        soft_targets: bool,
        dense_grad: th.Tensor | None,
    ) -> None: ...

    def move(
        self,
        exchange: Exchange,
        optimizers: Sequence[th.optim.Optimizer] = (),
        *,
        soft_targets: bool = True,
        dense_grad: th.Tensor | None = None,
    ) -> None:
        """Move connections; weights and moments of grown ones start at 0.

        :param exchange: the connections to drop (must be active) and to grow (must be inactive)
        :param optimizers: optimizers whose moments of the weight follow
        :param soft_targets: whether targets follow at once or keep their snapshot
        :param dense_grad: dense gradient of the next step, before clipping, from which grown
            connections get theirs; None: theirs is 0
        :raises TopologyError: if the exchange does not fit the mask or would leave it empty
        """
        mask = self.mask()
        dropped, grown = exchange.dropped, exchange.grown
        after = mask.copy()
        after[dropped] = False
        after[grown] = True
        left = np.count_nonzero(after)
        if (
            not mask[dropped].all()
            or mask[grown].any()
            or left != self.nnz - dropped.size + grown.size  # an index is repeated
            or left == 0
        ):
            raise TopologyError(
                f"the exchange for {self.name} drops {dropped.size} and grows {grown.size} of "
                f"{self.nnz} connections, but some of the dropped are not active, some of the "
                "grown are, an index is repeated, or no connection would be left"
            )
        self._move(after, optimizers, soft_targets, dense_grad)


def check_masked(optimizer: th.optim.Optimizer, layers: Iterable[LayerStorage]) -> None:
    """Reject sparse storage under an optimizer that does not move each weight by itself.

    :raises UnsupportedError: if a layer is sparse
    """
    sparse = next((layer.name for layer in layers if layer.is_sparse), None)
    if sparse is not None:
        raise UnsupportedError(
            f"{type(optimizer).__name__} does not move each weight by itself, as Adam does, so it "
            f"cannot move layers that store active connections only ({sparse}); make the policy "
            "with compute='masked', or use another optimizer_class"
        )
