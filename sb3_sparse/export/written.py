"""What an export writes, and what the check and the report need of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_sparse.export.artifact import GRAPH_ARTIFACTS, Artifact, dense_artifact
from sb3_sparse.export.calibrate import integer_graph
from sb3_sparse.export.fold import fold
from sb3_sparse.export.graph import Graph
from sb3_sparse.export.observations import Observations
from sb3_sparse.export.quantize import quantized
from sb3_sparse.export.sbx_model import NOT_CARRIED
from sb3_sparse.export.units import remove_dead_units, units_of
from sb3_sparse.policies.compiled import unwrapped


@dataclass(frozen=True)
class Written:
    """An artifact, and what it is made of.

    :param to: the format
    :param artifact: the files
    :param counts: connections, units and bytes, by their names in the report
    :param normalization: what is part of it; None: it takes observations as the policy sees them
    :param graph: its operations, with rounded weights if the files have such; None: none are known
    :param int8: what is stored as 8-bit numbers; None: nothing
    """

    to: str
    artifact: Artifact
    counts: dict[str, int]
    normalization: VecNormalize | None = None
    graph: Graph | None = None
    int8: str | None = None

    @property
    def further(self) -> dict[str, int]:
        """Number of elements of each output beside the action, by its name."""
        sizes = {} if self.graph is None else self.graph.sizes
        return {name: size for name, size in sizes.items() if name != "action"}


def of_model(model: BaseAlgorithm, normalization: VecNormalize | None, carried: bool) -> Written:
    """Make a zip of stock SB3, which does not normalise by itself.

    :param carried: whether the model was one of SBX
    """
    artifact = dense_artifact(model, normalization is not None)
    if carried:
        artifact = replace(artifact, notes=(*artifact.notes, NOT_CARRIED))
    nnz = _connections(model)
    return Written("dense", artifact, {"nnz": nnz, "exported_nnz": nnz})


def of_graph(
    raw: Graph,
    to: str,
    int8: str | None,
    normalization: VecNormalize | None,
    observations: Observations | None,
) -> Written:
    """Make the files of any other format.

    :param raw: the policy, dead units included
    :param int8: ``"weights"``, ``"full"`` or None
    :param normalization: what the graph begins with
    :param observations: recorded ones, from which ``"full"`` takes its ranges
    :raises UnsupportedError: if ``"full"`` cannot be had of the policy
    :raises MissingExtra: if the format needs a package that is not installed
    """
    exact = remove_dead_units(fold(raw))
    graph = integer_graph(exact, observations) if int8 == "full" else exact
    artifact = GRAPH_ARTIFACTS[to](graph, int8 is not None)
    counts = {
        "dense_bytes": sum(4 * (layer.weight.size + layer.bias.size) for layer in raw.layers),
        "nnz": raw.nnz,
        "exported_nnz": exact.nnz,
        "removed_units": units_of(raw) - units_of(exact),
        "units": units_of(raw),
    }
    graph = graph if int8 is None else quantized(graph)
    return Written(to, artifact, counts, normalization, graph, int8)


def _connections(model: BaseAlgorithm) -> int:
    """Count the connections that are not 0, without targets and with shared layers once."""
    layers = [
        module
        for name, module in unwrapped(model.policy).named_modules()
        if isinstance(module, (nn.Linear, nn.Conv2d)) and "target" not in name
    ]
    return sum(int(layer.weight.count_nonzero()) for layer in layers)
