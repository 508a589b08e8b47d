"""Translates the ``forward`` of a user's own module, if it is simple enough."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch as th
from torch import fx, nn

from sb3_sparse.export.activations import called, scaled
from sb3_sparse.export.builder import GraphBuilder
from sb3_sparse.export.nodes import Add, Multiply

ADD = (operator.add, operator.iadd, th.add, "add", "add_")
SUBTRACT = (operator.sub, operator.isub, th.sub, "sub", "sub_")
MULTIPLY = (operator.mul, operator.imul, th.mul, "mul", "mul_")
DIVIDE = (operator.truediv, operator.itruediv, th.div, "div", "div_")
NEGATE = (operator.neg, th.neg, "neg")
IN_PLACE = (operator.iadd, operator.isub, operator.imul, operator.itruediv)
CONCAT = (th.cat, th.concat, th.concatenate)
SQUARE = (operator.pow, th.pow, "pow", th.square, "square")
RESHAPE = ("view", "reshape", th.reshape)


Walk = Callable[[nn.Module, int], int]


def trace_forward(
    builder: GraphBuilder, walk: Walk, module: nn.Module, value: int | Mapping[str, int]
) -> int:
    """Apply a module to a value, or to a dict of values, and return the result.

    :param walk: applies a module that ``forward`` calls
    :raises UnsupportedError: if the module's ``forward`` does what cannot be exported
    """
    try:
        graph = _Leaves().trace(module)
    except Exception as error:  # whatever a forward does that cannot be traced
        raise builder.unsupported(module, f"its forward cannot be traced ({error})") from error
    values: dict[fx.Node, int] = {}
    observation: fx.Node | None = None
    sizes: set[fx.Node] = set()
    """Nodes that hold the batch size, or a shape, which begins with it."""
    for node in graph.nodes:
        taken = [values.get(arg) for arg in node.all_input_nodes]
        first = taken[0] if taken else None
        found = None
        if node.op == "placeholder" and observation is None:
            observation = node
            if not isinstance(value, int):
                continue
            found = value
        elif node.target is operator.getitem and node.args[0] is observation:
            found = None if isinstance(value, int) else value.get(str(node.args[1]))
        elif node.op == "output" and node.args[0] in values:
            return values[node.args[0]]
        elif node.op == "call_module" and len(taken) == 1 and first is not None:
            found = walk(module.get_submodule(str(node.target)), first)
        elif _is_size(node, sizes):
            sizes.add(node)
            continue
        elif node.op in ("call_function", "call_method") and first is not None:
            found = _call(builder, walk, node, values, sizes)
        if found is None:
            raise builder.unsupported(module, f"its forward {_description(node)}")
        values[node] = found
    raise AssertionError("a graph has an output")


class _Leaves(fx.Tracer):
    """Traces the ``forward`` of one module, not of its children."""

    def is_leaf_module(self, m: nn.Module, module_qualified_name: str) -> bool:
        return True


def _call(
    builder: GraphBuilder,
    walk: Walk,
    node: fx.Node,
    values: dict[fx.Node, int],
    sizes: set[fx.Node],
) -> int | None:
    """Return the result of a function or method; None if it cannot be exported."""
    target: Any = node.target
    arguments = list(node.args)
    options = dict(node.kwargs)
    inputs = [values[arg] for arg in arguments if isinstance(arg, fx.Node) and arg in values]
    if target in CONCAT:
        return _concat(builder, arguments, options, values)
    in_place = options.pop("inplace", False) or target in IN_PLACE or str(target).endswith("_")
    if in_place:
        builder.changed.update(builder.sources(inputs[0]))
    if target in RESHAPE:
        flat = _flattens(builder, inputs[0], arguments[1:], sizes) and not options
        return walk(nn.Flatten(), inputs[0]) if flat else None
    if target in SQUARE and arguments[1:] in ([], [2]) and not options:
        return builder.add(Multiply((inputs[0], inputs[0]), builder.shape_of(inputs[0])))
    if len(inputs) == 2 and len(arguments) == 2 and target in (*ADD, *MULTIPLY) and not options:
        shape = builder.shape_of(inputs[0])
        if shape != builder.shape_of(inputs[1]):
            return None
        kind = Add if target in ADD else Multiply
        return builder.add(kind((inputs[0], inputs[1]), shape))
    if len(inputs) != 1 or len(node.all_input_nodes) != 1:
        return None
    (value,) = inputs
    factor_and_shift = None if options else _arithmetic(target, arguments)
    if factor_and_shift is not None:
        for make in scaled(*factor_and_shift):
            value = builder.add(make(value, builder.shape_of(value)))
        return value
    made = called(target, arguments[1:], options)
    return None if made is None else walk(made, value)


def _concat(
    builder: GraphBuilder, arguments: list[Any], options: dict[str, Any], values: dict[fx.Node, int]
) -> int | None:
    """Concatenate values, if they are joined along the first axis of an observation."""
    parts, *rest = arguments
    axis = options.get("dim", rest[0] if rest else 0)
    if not isinstance(parts, (list, tuple)) or any(part not in values for part in parts):
        return None
    found = [values[part] for part in parts]
    shapes = [builder.shape_of(value) for value in found]
    if axis not in (1, -len(shapes[0])) or len({shape[1:] for shape in shapes}) > 1:
        return None
    return builder.concat(found)


def _arithmetic(target: Any, arguments: list[Any]) -> tuple[float, float] | None:
    """Return factor and summand of an arithmetic operation; None for any other."""
    if target in NEGATE:
        return -1.0, 0.0
    if len(arguments) != 2:
        return None
    first = isinstance(arguments[0], fx.Node)
    number = arguments[1 if first else 0]
    if isinstance(number, bool) or not isinstance(number, (int, float)):
        return None
    if target in ADD:
        return 1.0, float(number)
    if target in MULTIPLY:
        return float(number), 0.0
    if target in SUBTRACT:
        return (1.0, -float(number)) if first else (-1.0, float(number))
    if target in DIVIDE and first and number:
        return 1.0 / number, 0.0
    return None


def _is_size(node: fx.Node, sizes: set[fx.Node]) -> bool:
    """Tell whether a node leads to the batch size, as in ``x.view(x.size(0), -1)``."""
    if node.target == "size" or (node.target is getattr and node.args[1] == "shape"):
        return node.args[1:] in ((), (0,), ("shape",))
    of_a_shape = node.target is operator.getitem and node.args[0] in sizes
    return of_a_shape and node.args[1:] == (0,)


def _flattens(builder: GraphBuilder, value: int, wanted: list[Any], sizes: set[fx.Node]) -> bool:
    """Tell whether a new shape keeps the batch and puts all units in one row."""
    shape = list(wanted[0]) if len(wanted) == 1 and isinstance(wanted[0], tuple) else wanted
    if len(shape) != 2:
        return False
    units = int(np.prod(builder.shape_of(value)))
    kept = isinstance(shape[0], fx.Node) and shape[0] in sizes
    return bool((kept and shape[1] in (-1, units)) or shape == [-1, units])


def _description(node: fx.Node) -> str:
    """Describe what a node does."""
    if node.op == "placeholder":
        return f"takes {node.target} too"
    if node.op == "output":
        return "returns something other than one tensor"
    if node.op == "get_attr":
        return f"reads {node.target}"
    if node.op == "call_module":
        return f"calls {node.target} with something other than one tensor"
    target: Any = node.target
    name = target if isinstance(target, str) else getattr(target, "__name__", str(target))
    given = [repr(arg) for arg in node.args if not isinstance(arg, (fx.Node, tuple, list))]
    given += [f"{name}={value!r}" for name, value in node.kwargs.items()]
    return f"calls {name}({', '.join(given)})"
