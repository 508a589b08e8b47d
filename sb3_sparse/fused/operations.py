"""The operations of a program, as in ``fused.h`` of the kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sb3_sparse.fused.values import Value

SHARED = """
COPY ADD SUBTRACT MULTIPLY MULTIPLY_ADD DIVIDE LEAST LESS SAME CLAMP INSIDE EXP LOG SQRT ABS HUBER
SLOPE_INPUT FILL
"""
OTHERS = """
ACTIVATION SLOPE_RESULT SUM_FEATURES MAX_FEATURES PICK PUT ARGMAX SORT QUANTILE_HUBER LOAD_ROWS
LINEAR LINEAR_BACK LINEAR_GRAD LINEAR_DENSE_GRAD SUM_BATCH MEAN_BATCH DOT_BATCH CHECK
SPREAD EXPORT STORE PACK TURN MASK_GRADS CLIP_NORM OPTIMIZE POLYAK
"""
KINDS = {name: number for number, name in enumerate((SHARED + OTHERS).split())}
"""The number of each kind."""
READ_SHARED = set(SHARED.split())
"""Kinds that read what the whole batch shares, when they run on tiles."""


@dataclass
class Operation:
    """One operation, and the dependencies that determine its order.

    :param kind: a name of :data:`KINDS`
    :param to: the result; None if it is not a value of the program
    :param operands: up to three values that it reads
    :param features: features of the result
    :param first: start of a range of columns or parameters, or number of an activation
    :param last: end of the range
    :param number: number of a layer, parameter, input or activation
    :param p: first parameter of an activation, or a factor
    :param q: second parameter of an activation
    :param reads: keys that earlier operations must have written
    :param writes: keys that later operations may read
    :param tiled: whether it runs on each tile
    :param changes: whether it changes parameters, which all later operations must see
    """

    kind: str
    to: Value | None = None
    operands: tuple[Value, ...] = ()
    features: int = 0
    first: int = 0
    last: int = 0
    number: int = 0
    p: float = 0.0
    q: float = 0.0
    reads: tuple[Any, ...] = ()
    writes: tuple[Any, ...] = ()
    tiled: bool = True
    changes: bool = False


def in_phases(operations: list[Operation]) -> list[Operation]:
    """Order operations into few phases, so that a tile stays in the cache.

    An operation on tiles joins the phase of the latest tiles that it reads. If it reads the result
    of an operation between phases, such as a sum over the batch, it starts a later phase. An
    operation that changes parameters comes after all that were recorded before it, and before all
    that were recorded after it.
    """
    made: dict[Any, tuple[int, bool]] = {}
    epoch = latest = 0
    placed: list[tuple[int, int, Operation]] = []
    for operation in operations:
        before = [
            made[key]
            for key in (*(value.root for value in operation.operands), *operation.reads)
            if key in made
        ]
        if operation.tiled:
            phase = max([epoch, *(p if tiled else p + 1 for p, tiled in before)])
        else:
            phase = max([epoch - 1, *(p for p, _ in before)])
        if operation.changes:
            phase = latest
            epoch = phase + 1
        latest = max(latest, phase)
        placed.append((phase, 0 if operation.tiled else 1, operation))
        results = () if operation.to is None else (operation.to.root,)
        for key in (*results, *operation.writes):
            made[key] = max(
                made.get(key, (phase, operation.tiled)),
                (phase, operation.tiled),
                key=lambda at: (at[0], not at[1]),
            )
    placed.sort(key=lambda at: at[:2])  # stable
    return [operation for *_, operation in placed]
