"""Runs programs on a policy's tensors."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch as th

from sb3_sparse.engine.controller import Controller
from sb3_sparse.engine.native.library import bits_of, library
from sb3_sparse.engine.products import TILE
from sb3_sparse.fused.inputs import Inputs
from sb3_sparse.fused.memory import Memory, Place
from sb3_sparse.fused.operations import KINDS, in_phases
from sb3_sparse.fused.program import Program
from sb3_sparse.fused.recording import Minimised
from sb3_sparse.fused.tables import Tables
from sb3_sparse.fused.values import Value


class Machine:
    """Owns the memory of a program and runs it.

    :param program: the program
    :param controller: controller of the policy whose tensors the program moves
    :param batch: maximum batch size
    :raises ValueError: if running statistics of the program would never move
    """

    def __init__(self, program: Program, controller: Controller, batch: int) -> None:
        self.program = program
        self.controller = controller
        self.capacity = batch
        if program.statistics:
            raise ValueError(
                "a training_network has no minimise after it, which moves its statistics"
            )
        self.operations = in_phases(program.operations)
        self.steps = [self._index_of(m.step) for m in program.minimised]
        self._counters = [(self._index_of(stored), steps) for stored, steps in program.counters]
        self._marks = {name: self._index_of(step) + 1 for name, step in program.marks.items()}
        self.tables = Tables(program, controller)
        self.threads = th.get_num_threads()
        memory = Memory(self.operations, program.values, batch, self.threads)
        self._places: dict[Value, Place] = memory.places
        self._work = memory.work
        self._at = self._work.data_ptr()
        self._view = self._work.numpy()
        self._lanes = {
            name: self._view[self._place(value) : self._place(value) + TILE]
            for name, value in program.scalars.items()
        }
        for number, value in program.constants.items():
            self._view[self._place(value) : self._place(value) + TILE] = number
        self._logged = {name: self._place(value) for name, value in program.logged.items()}
        fields = [field for operation in self.operations for field in self._fields(operation)]
        self._operations = (ctypes.c_int64 * len(fields))(*fields)
        self.inputs = Inputs(program.rows)
        self._indices: dict[str, tuple[Any, int]] = {}
        self._argument = (ctypes.c_int64 * 8)()
        self._call = library().sb3_sparse_fused
        self.batch = 0

    def _index_of(self, operation: Any) -> int:
        return next(i for i, one in enumerate(self.operations) if one is operation)

    def _place(self, value: Value) -> int:
        return self._places[value.root].at + TILE * value.offset

    def _operand(self, value: Value | None) -> tuple[int, ...]:
        """``place_t`` of ``fused.h``."""
        if value is None:
            return 0, 0, 0, 0
        _, thread, tile = self._places[value.root]
        feature = 0 if value.features == 1 else TILE
        return self._at + 4 * self._place(value), thread, tile, feature

    def _fields(self, operation: Any) -> list[int]:
        """``operation_t`` of ``fused.h``."""
        operands = [*operation.operands, None, None, None][:3]
        return [
            KINDS[operation.kind],
            int(operation.tiled),
            *self._operand(operation.to),
            *(field for operand in operands for field in self._operand(operand)),
            operation.features,
            operation.first,
            operation.last,
            operation.number,
            bits_of(operation.p),
            bits_of(operation.q),
        ]

    def prepare(self) -> None:
        """Read the present addresses of the tensors and the settings of the optimizers.

        :raises NotCovered: if the kernels cannot read a tensor
        """
        self.tables.refresh()
        argument: Any = self._argument
        argument[0] = ctypes.addressof(self._operations)
        argument[1:4] = self.tables.addresses
        argument[4] = self.inputs.address
        argument[6] = min(self.threads, th.get_num_threads())
        argument[7] = self.tables.per_thread

    def set(self, scalars: Mapping[str, float]) -> None:
        """Set the program's scalars; names that it does not use are ignored."""
        for name, number in scalars.items():
            if name in self._lanes:
                self._lanes[name][:] = number

    def load(self, rows: Mapping[str, th.Tensor]) -> None:
        """Set the program's inputs from tensors.

        :param rows: as for :meth:`Inputs.load`
        :raises NotCovered: if a type or shape does not fit
        """
        self.set_batch(self.inputs.load(rows))

    def index(self, name: str, batch: int) -> tuple[Any, int]:
        """Return an int64 array for the row numbers of a batch, and its fixed address.

        :param name: name of the index
        :param batch: batch size
        """
        if name not in self._indices:
            made = np.zeros(self.capacity, dtype=np.int64)
            self._indices[name] = made, made.ctypes.data
        array, address = self._indices[name]
        self.set_batch(batch)
        return array[:batch], address

    def set_batch(self, batch: int) -> None:
        """Set the batch size."""
        if batch != self.batch:
            self.batch = batch
            self._argument[5] = batch
            self.set({"1 / batch": 1 / batch, "batch - 1": batch - 1})

    def mark(self, name: str) -> int:
        """Return the position of a mark of the program, for :meth:`run`.

        :raises ValueError: if the program has no such mark
        """
        if name not in self._marks:
            raise ValueError(
                f"the recorded gradient step has no mark {name!r}, which this algorithm needs: "
                f"call program.mark({name!r}) in _record, behind the minimise that it follows"
            )
        return self._marks[name]

    def number(self, name: str) -> float:
        """Return the number that the last run logged under ``name``."""
        return float(self._view[self._logged[name]])

    def run(
        self, first: int = 0, last: int | None = None, failed: Callable[[str], None] | None = None
    ) -> None:
        """Run the program, or a range of its operations.

        Torch takes the steps of optimizers that the kernels do not know, and those at which masks
        move.

        :param first: first operation
        :param last: end of the range; None: all that follow
        :param failed: called with the name of a check that fails, before the next operation; if it
            returns, the run continues
        """
        last = len(self.operations) if last is None else last
        for minimised, step in zip(self.program.minimised, self.steps, strict=True):
            if not first <= step < last:
                continue
            by_kernels = self.tables.ready(minimised)
            if by_kernels and not self.controller.needs_torch(minimised.optimizer):
                continue
            self._go(first, step, failed)
            self._step_by_torch(minimised, step)
            first = step + 1
        self._go(first, last, failed)

    def _go(self, first: int, last: int, failed: Callable[[str], None] | None = None) -> None:
        while True:
            at = self._call(self._argument, first, last)
            self._count(first, last if at < 0 else at)
            if at < 0:
                return
            if failed is not None:
                failed(self.program.checks[id(self.operations[at])])
            first = at + 1

    def _count(self, first: int, last: int) -> None:
        """Count the optimizer steps, and the batches of norms, within a range of operations."""
        for stored, steps in self._counters:
            if first <= stored < last:
                steps.add_(1)
        for minimised, step in zip(self.program.minimised, self.steps, strict=True):
            if first <= step < last:
                self.controller.count_step(minimised.optimizer)
                self.tables.count(minimised)

    def _step_by_torch(self, minimised: Minimised, step: int) -> None:
        optimizer = minimised.optimizer
        self.tables.hand_over(minimised)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        self.prepare()
        self._repack(step)

    def _repack(self, step: int) -> None:
        """Read weights again that a step wrote or moved in memory.

        :param step: index of the step; operations after it run again anyway
        """
        for i, operation in enumerate(self.operations[:step]):
            if operation.kind in ("PACK", "TURN"):  # a layer's PACK comes before its TURN
                self._go(i, i + 1)
