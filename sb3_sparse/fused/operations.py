"""Operations of a program, as ``fused.h`` of the kernels has them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sb3_sparse.fused.values import Value

NAMES = """
COPY ADD SUBTRACT MULTIPLY DIVIDE LEAST LESS SAME CLAMP INSIDE EXP LOG SQRT ABS HUBER ACTIVATION
SLOPE_RESULT SLOPE_INPUT FILL SUM_FEATURES MAX_FEATURES PICK PUT LOAD_ROWS LINEAR LINEAR_BACK
LINEAR_GRAD LINEAR_DENSE_GRAD SUM_BATCH CHECK SPREAD EXPORT PACK TURN MASK_GRADS CLIP_NORM OPTIMIZE
POLYAK
"""
KINDS = {name: number for number, name in enumerate(NAMES.split())}
"""Number of each kind."""


@dataclass
class Operation:
    """One operation, and what the order of all goes by.

    :param kind: a name of :data:`KINDS`
    :param to: the result; None if it is none of the program's values
    :param operands: up to three values that it reads
    :param features: of the result
    :param first: of a range: columns, parameters; or an activation
    :param last: behind the range
    :param number: of a layer, parameter, input or activation
    :param p: parameter of an activation, or a factor
    :param q: the other parameter
    :param reads: what else must be there before
    :param writes: what else is there afterwards
    :param tiled: whether it runs on each tile
    :param changes: whether it changes parameters, so that all after it must see them changed
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
    """The same operations in an order with few phases, so that a tile stays in the cache.

    An operation on tiles joins the phase of the latest tiles that it reads; one that reads what was
    made between phases, a sum over the batch say, begins a later one. What changes parameters comes
    after everything that was recorded before it, and before everything recorded after.
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
