"""Writes a policy as an ONNX model."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto, checker, helper

from sb3_sparse.export.graph import Graph, Output
from sb3_sparse.export.nodes import (
    Activation,
    Add,
    Affine,
    Argmax,
    Clip,
    Concat,
    Conv,
    Flatten,
    Linear,
    MaxPool,
    Multiply,
    Node,
    Normalize,
    OneHot,
    Pairwise,
    Positive,
    Slice,
    Slopes,
    Standardize,
)
from sb3_sparse.export.onnx_writer import OnnxWriter
from sb3_sparse.export.output_nodes import Constant, Largest, Minimum

OPSET = 17
IR_VERSION = 8
PAIRWISE: dict[type[Node], str] = {Add: "Add", Multiply: "Mul", Minimum: "Min"}


def write_onnx(graph: Graph, version: str) -> bytes:
    """Return the bytes of a model with one input, ``obs``, and the output ``action``.

    Further outputs are named, too: ``value``, ``mean``, ``std`` and ``logits``, all float32.

    Inputs and outputs are batched. A dict observation has an input for each key, named after the
    key. Images are uint8, other observations float32; actions are float32, or int64 if they are
    whole numbers. Weights are dense, since ONNX runtimes have no sparse products.

    :param version: version of this package, which the model names as its producer
    """
    writer = _GraphWriter()
    if graph.parts:
        rows = [
            writer.row(f"{part.key}_row", part.key, part.size, part.pixels) for part in graph.parts
        ]
        writer.node("Concat", rows, "value_0", axis=1)
    elif graph.images:
        writer.node("Cast", ["obs"], "value_0", to=TensorProto.FLOAT)
    for value, node in enumerate(graph.nodes, start=1):
        inputs = [_name(taken, graph) for taken in node.inputs]
        writer.write(node, inputs, f"value_{value}")
    for one in graph.outputs:
        shape = writer.array([-1, *one.shape], np.int64)
        writer.node("Reshape", [f"value_{one.value}", shape], one.name)
    made = helper.make_graph(
        writer.nodes,
        "policy",
        [_input(*asked) for asked in inputs_of(graph)],
        [_output(one, graph) for one in graph.outputs],
        writer.arrays,
    )
    model = helper.make_model(
        made,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="sb3_sparse",
        producer_version=version,
    )
    checker.check_model(model, full_check=True)
    written: bytes = model.SerializeToString(deterministic=True)
    return written


def inputs_of(graph: Graph) -> list[tuple[str, tuple[int, ...], bool]]:
    """Return name and shape of each input of the model, and whether it is uint8."""
    if not graph.parts:
        return [("obs", graph.observation_shape, graph.images)]
    return [(part.key, part.shape or (1,), part.pixels) for part in graph.parts]


def _input(name: str, shape: tuple[int, ...], pixels: bool) -> Any:
    kind = TensorProto.UINT8 if pixels else TensorProto.FLOAT
    return helper.make_tensor_value_info(name, kind, ["batch", *shape])


def _output(output: Output, graph: Graph) -> Any:
    whole = output.name == "action" and graph.discrete
    kind = TensorProto.INT64 if whole else TensorProto.FLOAT
    return helper.make_tensor_value_info(output.name, kind, ["batch", *output.shape])


def _name(value: int, graph: Graph) -> str:
    return "obs" if value == 0 and not graph.images and not graph.parts else f"value_{value}"


class _GraphWriter(OnnxWriter):
    """Translates the operations of a graph."""

    def row(self, output: str, x: str, size: int, pixels: bool) -> str:
        """Append the nodes that flatten an input to a row, and return the row's name."""
        if pixels:
            x = self.node("Cast", [x], f"{output}_float", to=TensorProto.FLOAT)
        return self.node("Reshape", [x, self.array([-1, size], np.int64)], output)

    def write(self, node: Node, inputs: list[str], output: str) -> None:
        """Append the nodes that compute a node of the graph."""
        if isinstance(node, Linear):
            constants = [self.array(node.weight), self.array(node.bias)]
            self.node("Gemm", [*inputs, *constants], output, transB=1)
        elif isinstance(node, Conv):
            constants = [self.array(node.weight), self.array(node.bias)]
            sizes = dict(strides=node.stride, pads=[*node.padding, *node.padding])
            self.node("Conv", [*inputs, *constants], output, **sizes)
        elif isinstance(node, MaxPool):
            self.node(
                "MaxPool",
                inputs,
                output,
                kernel_shape=node.kernel,
                strides=node.stride,
                pads=[*node.padding, *node.padding],
            )
        elif isinstance(node, Activation):
            self.activation(node, inputs[0], output)
        elif isinstance(node, Slopes):
            slope = self.array(_batch_first(node.fields()["slope"])[0])
            self.node("PRelu", [*inputs, slope], output)
        elif isinstance(node, Normalize):
            fields = {name: _batch_first(field) for name, field in node.fields().items()}
            centred = self.node("Sub", [*inputs, self.array(fields["mean"])], f"{output}_centred")
            exact = self.node("Sub", [centred, self.array(fields["rest"])], f"{output}_exact")
            scaled = self.node("Mul", [exact, self.array(fields["scale"])], f"{output}_scaled")
            bounds = [self.array(-node.clip), self.array(node.clip)]
            self.node("Clip", [scaled, *bounds], output)
        elif isinstance(node, (Affine, Clip)):
            first, second = (_batch_first(field) for field in node.fields().values())
            kinds = ("Mul", "Add") if isinstance(node, Affine) else ("Max", "Min")
            half = self.node(kinds[0], [*inputs, self.array(first)], f"{output}_half")
            self.node(kinds[1], [half, self.array(second)], output)
        elif isinstance(node, Flatten):
            self.node("Flatten", inputs, output)
        elif isinstance(node, Pairwise):
            self.node(PAIRWISE[type(node)], inputs, output)
        elif isinstance(node, Largest):
            self.node("ReduceMax", inputs, output, axes=[1], keepdims=1)
        elif isinstance(node, Constant):
            count = self.node("Shape", inputs, f"{output}_count", start=0, end=1)
            whole = [count, self.array(node.shape, np.int64)]
            self.node("Concat", whole, f"{output}_shape", axis=0)
            self.node("Expand", [self.array(node.numbers), f"{output}_shape"], output)
        elif isinstance(node, Standardize):
            ones = self.array(np.ones(node.shape))
            self.node("LayerNormalization", [*inputs, ones], output, epsilon=node.eps)
        elif isinstance(node, Concat):
            self.node("Concat", inputs, output, axis=1)
        elif isinstance(node, Slice):
            (start, stop), shape = node.fields().values()
            ends = [self.array([end], np.int64) for end in (start, stop, 1)]
            part = self.node("Slice", [*inputs, *ends], f"{output}_row")
            self.node("Reshape", [part, self.array([-1, *shape], np.int64)], output)
        elif isinstance(node, OneHot):
            self._one_hot(node, inputs[0], output)
        elif isinstance(node, Argmax):
            self._argmax(node, inputs[0], output)
        else:
            assert isinstance(node, Positive)
            positive = self.node("Greater", [*inputs, self.array(0.0)], f"{output}_positive")
            self.node("Cast", [positive], output, to=TensorProto.INT64)

    def _one_hot(self, node: OneHot, x: str, output: str) -> None:
        columns = self.array(np.repeat(np.arange(len(node.sizes)), node.sizes), np.int64)
        each = self.node("Gather", [x, columns], f"{output}_each", axis=1)
        values = self.array(node.fields()["values"].T)
        same = self.node("Equal", [each, values], f"{output}_same")
        self.node("Cast", [same], output, to=TensorProto.FLOAT)

    def _argmax(self, node: Argmax, scores: str, output: str) -> None:
        parts = [f"{output}_part_{i}" for i in range(len(node.sizes))]
        sizes = self.array(node.sizes, np.int64)
        self.nodes.append(helper.make_node("Split", [scores, sizes], parts, axis=1))
        best = [self.node("ArgMax", [part], f"{part}_best", axis=1) for part in parts]
        self.node("Concat", best, output, axis=1)


def _batch_first(field: NDArray[Any]) -> NDArray[Any]:
    """Move the batch of a node's field from the last axis to the first."""
    return np.moveaxis(field, -1, 0) if field.ndim > 1 else field
