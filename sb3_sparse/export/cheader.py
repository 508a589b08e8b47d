"""The header of a policy in C: what the caller declares, and the comment that explains it."""

from __future__ import annotations

import textwrap

import numpy as np

from sb3_sparse.export.graph import Graph
from sb3_sparse.export.nodes import Argmax, Positive

WIDTH = 100
STACK = 512
"""Bytes that no policy's calls need; the most that was seen is 264, on a Cortex-M0 at -O2."""


def prototype(graph: Graph) -> str:
    """Return the function's declaration, without the semicolon."""
    outputs = ", ".join(f"float *{output.name}" for output in graph.outputs)
    return f"void sb3_sparse_policy(const float *obs, {outputs})"


def about(graph: Graph, version: str, flash: int, ram: int) -> str:
    """Return the comment that both files begin with."""
    lines = [
        f"A policy of {graph.nnz} connections, written by sb3_sparse {version}.",
        f"Flash: {flash} bytes of constants, and the code. RAM: {ram} bytes, no heap.",
        f"Stack: less than {STACK} bytes on a 32-bit processor.",
        *textwrap.wrap(f"In: one observation of {_asked(graph)}, raw.", WIDTH - 3),
        f"Out: {_given(graph)}.",
    ]
    for output in graph.outputs[1:]:
        said = f"{output.name}: {_numbers(graph.sizes[output.name])}, {output.meaning}."
        lines += textwrap.wrap(said, WIDTH - 3)
    return "/*\n" + "".join(f" * {line}\n" for line in lines).replace("*/", "* /") + " */\n"


def declarations(graph: Graph) -> str:
    """Return the header without its comment."""
    sizes = "".join(
        f"#define SB3_SPARSE_{name.upper()}_SIZE {size}\n" for name, size in graph.sizes.items()
    )
    return (
        "#ifndef SB3_SPARSE_POLICY_H\n#define SB3_SPARSE_POLICY_H\n\n"
        f"#define SB3_SPARSE_OBSERVATION_SIZE {int(np.prod(graph.observation_shape))}\n"
        f"{sizes}\n"
        '#ifdef __cplusplus\nextern "C" {\n#endif\n\n'
        "/* Not reentrant: its intermediate values are static. */\n"
        f"{prototype(graph)};\n\n"
        "#ifdef __cplusplus\n}\n#endif\n\n#endif\n"
    )


def _shape(shape: tuple[int, ...]) -> str:
    return "x".join(map(str, shape))


def _asked(graph: Graph) -> str:
    if not graph.parts:
        return _shape(graph.observation_shape)
    parts = [f"{part.key!r} ({_shape(part.shape or (1,))})" for part in graph.parts]
    return f"{graph.observation_shape[0]} numbers: {', then '.join(parts)}"


def _given(graph: Graph) -> str:
    last, actions = graph.action, graph.sizes["action"]
    if isinstance(last, Argmax):
        choices = ", ".join(map(str, last.sizes))
        return f"{actions} whole number{'s' * (actions > 1)}, below {choices}"
    if isinstance(last, Positive):
        return f"{actions} times 0 or 1"
    return f"{_numbers(actions)}, within the action space's bounds"


def _numbers(count: int) -> str:
    return f"{count} number{'s' * (count > 1)}"
