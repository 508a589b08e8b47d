"""Tables of the addresses of a program's layers, parameters and optimizers."""

from __future__ import annotations

import ctypes
from itertools import chain
from typing import Any

import torch as th

from sb3_sparse.engine.controller import Controller
from sb3_sparse.engine.native.library import bits_of
from sb3_sparse.fused.optimizers import FIELDS, Steps
from sb3_sparse.fused.program import Program
from sb3_sparse.fused.recording import Minimised, Slot
from sb3_sparse.fused.storage import Storage, Stored, check_readable

ALIGNED = 16
"""Numbers in a cache line."""


def _empty(count: int) -> th.Tensor:
    return th.zeros(count, dtype=th.float32, device="cpu")


def _padded(count: int) -> int:
    return -(-count // ALIGNED) * ALIGNED


class Tables:
    """Keeps the tables of ``linear_t``, ``parameter_t`` and ``group_t`` of ``fused.h`` up to date.

    :param program: the program
    :param controller: controller of the policy
    """

    def __init__(self, program: Program, controller: Controller) -> None:
        self._program = program
        self._controller = controller
        self._storage = Storage(controller, program.layers)
        followed = {
            program.slots[operation.last].layer
            for operation in program.operations
            if operation.kind == "POLYAK"
        }
        self._follows = [number in followed for number in range(len(program.layers))]
        self._steps: dict[int, Steps] = {}
        for m in program.minimised:
            tensors = [slot.tensor for slot in program.slots[slice(*m.slots)]]
            self._steps[id(m.optimizer)] = Steps(m.optimizer, tensors, controller)
        self._tensors = list({id(slot.tensor): slot.tensor for slot in program.slots}.values())
        self._groups: dict[int, int] = {}
        self._settings: list[Any] = []
        self._state: Any = None
        self._stored: list[Stored] = []
        self._held: list[Any] = []
        self._grads = _empty(0)
        self._places: dict[int, tuple[int, int]] = {}
        self._ready: dict[int, bool] = {}
        self._dense_grads: dict[int, th.Tensor] = {}
        self._arrays: list[Any] = [(ctypes.c_int64 * 1)()] * 3
        self.per_thread = 0
        decayed = controller.weight_decay and {
            id(weight) for network in controller.networks for weight in network.weights
        }
        self._decayed = decayed or set()

    @property
    def addresses(self) -> list[int]:
        """Addresses of the three tables."""
        return [ctypes.addressof(array) for array in self._arrays]

    def ready(self, minimised: Minimised) -> bool:
        """Whether the kernels can take the optimizer's next step."""
        return self._ready[id(minimised.optimizer)]

    def count(self, minimised: Minimised) -> None:
        """Count a step that the kernels take."""
        self._steps[id(minimised.optimizer)].count()

    def refresh(self) -> None:
        """Read the present addresses and settings.

        :raises NotCovered: if the kernels cannot read something
        """
        steps = self._steps.values()
        for one in steps:
            one.refresh()
        settings = [one.groups for one in steps]
        if settings != self._settings:
            self._fill_groups()
            self._settings = settings
        state = [
            *map(th.Tensor.data_ptr, self._tensors),
            *self._storage.state(),
            *chain.from_iterable(one.state() for one in steps),
            th.get_num_threads(),
        ]
        if state != self._state:
            self._state = None
            self._fill()
            self._state = state

    def _fill_groups(self) -> None:
        fields: list[int] = []
        self._groups = {}
        for minimised in self._program.minimised:
            groups = self._steps[id(minimised.optimizer)].groups or []
            for group, found in zip(minimised.optimizer.param_groups, groups, strict=False):
                for parameter in group["params"]:
                    self._groups[id(parameter)] = len(fields) // FIELDS
                fields += found
        self._arrays[2] = (ctypes.c_int64 * max(1, len(fields)))(*fields)

    def _fill(self) -> None:
        program = self._program
        self._held = []
        self._ready = {key: steps.ready for key, steps in self._steps.items()}
        self._stored = [
            self._storage.of(module, follows)
            for module, follows in zip(program.layers, self._follows, strict=True)
        ]
        self._place_grads()
        packed = {
            number: _empty(stored.size)
            for number, stored in enumerate(self._stored)
            if stored.flat is not None
        }
        fields: list[int] = []
        for number, stored in enumerate(self._stored):
            fields += self._linear(number, stored, packed.get(number))
        self._arrays[0] = (ctypes.c_int64 * max(1, len(fields)))(*fields)
        fields = []
        for slot in program.slots:
            fields += self._parameter(slot, packed)
        self._arrays[1] = (ctypes.c_int64 * max(1, len(fields)))(*fields)

    def _place_grads(self) -> None:
        """Allocate the gradient of each parameter, once for each thread."""
        self._places = {}
        at = 0
        for slot in self._program.slots:
            if slot.optimizer is not None and id(slot.tensor) not in self._places:
                count = self._count(slot)
                self._places[id(slot.tensor)] = at, count
                at += _padded(count)
        self.per_thread = at
        self._grads = _empty(at * max(1, th.get_num_threads()))

    def _count(self, slot: Slot) -> int:
        return slot.tensor.numel() if slot.layer is None else self._stored[slot.layer].size

    def _grad_at(self, tensor: th.Tensor | None) -> int:
        place = None if tensor is None else self._places.get(id(tensor))
        return 0 if place is None else self._grads.data_ptr() + 4 * place[0]

    def _address(self, tensor: th.Tensor | None) -> int:
        """Return the address of a tensor, and hold the tensor so that it stays allocated."""
        if tensor is None:
            return 0
        self._held.append(tensor)
        return tensor.data_ptr()

    def _linear(self, number: int, stored: Stored, packed: th.Tensor | None) -> list[int]:
        module = self._program.layers[number]
        shape = module.out_features, module.in_features
        structure = stored.structure
        self._held.append(structure)
        addresses = (0,) * 5 if structure is None else structure.addresses
        turned = None if structure is None else _empty(structure.nnz)
        dense = None
        if self._captures(number):
            dense = self._dense_grads[number] = _empty(shape[0] * shape[1])
        if module.bias is not None:
            check_readable(module.bias)
        numbers = (stored.numbers if packed is None else packed, module.bias, turned)
        grads = (self._grad_at(module.weight), self._grad_at(module.bias))
        return [*shape, *addresses, *map(self._address, numbers), *grads, self._address(dense)]

    def _captures(self, number: int) -> bool:
        weight = self._program.layers[number].weight
        return any(
            slot.tensor is weight
            for m in self._program.minimised if m.captured
            for slot in self._program.slots[slice(*m.slots)]
        )  # fmt: skip

    def _parameter(self, slot: Slot, packed: dict[int, th.Tensor]) -> list[int]:
        number, flat, mask = slot.tensor, None, None
        if slot.layer is not None:
            stored = self._stored[slot.layer]
            number, flat, mask = stored.numbers, stored.flat, stored.mask
        check_readable(number)
        first = second = steps = None
        if slot.optimizer is not None and self._ready[id(slot.optimizer)]:
            first, second, steps = self._steps[id(slot.optimizer)].moments(slot.tensor)
            for moment in (first, second):
                if moment is not None:
                    check_readable(moment)
            if steps is None:
                steps = _empty(1)
        decay = self._controller.weight_decay if id(slot.tensor) in self._decayed else 0.0
        values = (number, flat, mask, None if slot.layer is None else packed.get(slot.layer))
        return [
            self._count(slot),
            *map(self._address, values),
            self._grad_at(slot.tensor),
            *map(self._address, (first, second, steps)),
            self._groups.get(id(slot.tensor), 0),
            bits_of(decay),
        ]

    def hand_over(self, minimised: Minimised) -> None:
        """Copy the gradients that the kernels have computed to torch's parameters."""
        for group in minimised.optimizer.param_groups:
            for parameter in group["params"]:
                parameter.grad = None
        for slot in self._program.slots[slice(*minimised.slots)]:
            at, count = self._places[id(slot.tensor)]
            grad = self._grads[at : at + count].clone()
            stored = None if slot.layer is None else self._stored[slot.layer]
            if stored is not None and stored.flat is not None:
                dense = _empty(slot.tensor.numel())
                dense[stored.flat.long()] = grad
                grad = dense
            slot.tensor.grad = grad.view(slot.tensor.shape)
            if stored is not None and stored.layer is not None and minimised.captured:
                assert slot.layer is not None
                dense = self._dense_grads[slot.layer].clone()
                stored.layer.note_gradient(dense.view(stored.layer.shape))
