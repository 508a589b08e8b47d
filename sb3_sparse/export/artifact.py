"""The files of each format, and how they are run for the check."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_sparse.errors import ConfigError, MissingExtra
from sb3_sparse.export import numpy_policy
from sb3_sparse.export.c import write_c
from sb3_sparse.export.compiler import compiled
from sb3_sparse.export.dense import write_dense
from sb3_sparse.export.graph import Graph
from sb3_sparse.export.npz import write_npz
from sb3_sparse.export.observations import Observations, count_of, row_of
from sb3_sparse.export.parity import Actor, ParityError
from sb3_sparse.export.reference import predictor
from sb3_sparse.export.units import sort_units
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.saving import load_without_buffer


@dataclass(frozen=True)
class Artifact:
    """An exported policy that is not on disk yet.

    :param files: contents by name; a name that begins with a dot is the suffix of the main file
    :param actor: returns a function that runs it
    :param notes: what the user must know
    :param sizes: bytes needed where it runs, by kind
    """

    files: dict[str, bytes]
    actor: Callable[[], Actor]
    notes: tuple[str, ...] = ()
    sizes: dict[str, int] = field(default_factory=dict)

    def write(self, main: Path) -> dict[Path, int]:
        """Write all files, or none if one cannot be written; return their sizes.

        :param main: path of the main file
        :raises ConfigError: if one of them is a folder
        """
        main.parent.mkdir(parents=True, exist_ok=True)
        paths = {
            main.with_suffix(name) if name.startswith(".") else main.parent / name: content
            for name, content in self.files.items()
        }
        with tempfile.TemporaryDirectory(dir=main.parent, prefix=".export_") as folder:
            for path, content in paths.items():
                if path.is_dir():
                    raise ConfigError(
                        f"{path} is a folder and cannot be written; give another name"
                    )
                (Path(folder) / path.name).write_bytes(content)
            for path in paths:
                (Path(folder) / path.name).replace(path)
        return {path: len(content) for path, content in paths.items()}


def c_artifact(graph: Graph, int8: bool) -> Artifact:
    """Write a C file and its header."""
    written = write_c(sort_units(graph), version("sb3-sparse"), int8)
    return Artifact(
        {".c": written.source.encode(), ".h": written.header.encode()},
        lambda: compiled(written.source, graph),
        sizes={"flash": written.flash, "RAM": written.ram},
    )


def numpy_artifact(graph: Graph, int8: bool) -> Artifact:
    """Write an .npz file and its loader."""
    content = write_npz(graph)
    loader = Path(numpy_policy.__file__).read_bytes()

    def actor() -> Actor:
        policy: Any = numpy_policy.Policy(io.BytesIO(content))  # type: ignore[no-untyped-call]

        def run(observations: Observations) -> NDArray[Any]:
            count = count_of(observations)
            if not graph.parts:
                observations = np.reshape(observations, (count, *graph.observation_shape))
            many = policy(observations)
            one = policy(row_of(observations, 0))  # a single observation must work, too
            if not graph.chosen:
                many, one = (many,), (one,)
            rows = _side_by_side(many, count)
            rows[:1] = _side_by_side(one, 1)
            return rows

        return run

    return Artifact({".npz": content, Path(numpy_policy.__file__).name: loader}, actor)


def onnx_artifact(graph: Graph, int8: bool) -> Artifact:
    """Write an ONNX model."""
    try:
        from sb3_sparse.export.onnx_model import inputs_of, write_onnx
    except ImportError as error:
        raise MissingExtra("exporting to ONNX", "export") from error
    content = write_onnx(graph, version("sb3-sparse"))

    def actor() -> Actor:
        try:
            import onnxruntime
        except ImportError as error:
            raise MissingExtra("checking an ONNX model", "export") from error
        session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])

        def run(observations: Observations) -> NDArray[Any]:
            given = observations if graph.parts else {"obs": observations}
            inputs = {}
            for name, shape, pixels in inputs_of(graph):
                kind = np.uint8 if pixels else np.float32
                inputs[name] = np.reshape(given[name], (-1, *shape)).astype(kind)
            return _side_by_side(session.run(None, inputs), count_of(observations))

        return run

    return Artifact({".onnx": content}, actor)


def _side_by_side(outputs: Sequence[NDArray[Any]], count: int) -> NDArray[Any]:
    """Put outputs side by side in a row for each observation."""
    return np.concatenate([np.reshape(output, (count, -1)) for output in outputs], axis=1)


GRAPH_ARTIFACTS: dict[str, Callable[[Graph, bool], Artifact]] = {
    "c": c_artifact,
    "numpy": numpy_artifact,
    "onnx": onnx_artifact,
}
"""Writers by format: from a graph, and whether weights are 8-bit numbers (in C only)."""


def dense_artifact(model: BaseAlgorithm, normalised: bool) -> Artifact:
    """Write a zip of stock SB3.

    :param normalised: whether the model was trained on observations that VecNormalize normalised
    """
    content = write_dense(model)

    def actor() -> Actor:
        try:
            stock = load_without_buffer(type(model), io.BytesIO(content), device="cpu")
        except RuntimeError as error:  # torch's, of a state_dict that does not fit
            what = " ".join(str(error).split()).rstrip(". ")  # torch writes several lines
            raise ParityError(
                f"stock SB3 cannot load the policy as a dense zip: {what}. The policy has other "
                "parameters than its class makes, as after layers were parametrized or replaced "
                "later; build them in the policy's arguments, or export to c, numpy or onnx"
            ) from error
        return predictor(stock, None)

    notes = ["if stock SB3 trains it further, it becomes dense: nothing keeps the zeros"]
    if normalised:
        notes.append(
            "a zip of SB3 does not normalise observations: load the statistics with "
            "VecNormalize.load, as for the model"
        )
    policy = unwrapped(model.policy)
    if isinstance(policy, BaseSparsePolicy) and policy.sparse.weight_decay:
        notes.append("weight_decay is left out: only sparse policies have it")
    return Artifact({".zip": content}, actor, tuple(notes))
