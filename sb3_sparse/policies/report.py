"""The report on a policy's layers: shapes, connections, FLOPs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from stable_baselines3.common.policies import BasePolicy

from sb3_sparse.engine.network import SparseNetwork
from sb3_sparse.engine.prunable import Prunable
from sb3_sparse.policies.costs import conv_positions, flops_behind
from sb3_sparse.policies.spec import NetworkSpec, in_target

SPARSE = "sparse"
MASKED = "masked"
DENSE = "dense"
COMPUTES = (SPARSE, MASKED, DENSE)
"""How a layer can compute."""


@dataclass(frozen=True)
class LayerReport:
    """One layer in a report.

    :param network: name of the network that it belongs to
    :param name: dotted name within the policy
    :param shape: weight shape, torch order
    :param nnz: active connections
    :param parameters: nnz and biases
    :param flops: FLOPs of one forward pass at batch 1: 2 for a multiply-add, 1 for each bias, and
        those of what comes behind the layer (see
        :func:`~sb3_sparse.policies.costs.flops_per_unit`)
    :param dense_flops: the same for the dense layer; 0: neither these nor ``flops`` are known
    :param in_budget: False for a layer left dense by ``dense_layers``
    :param compute: how it computes: ``"sparse"``: with its active connections only;
        ``"masked"``: with a dense weight that is 0 where inactive; ``"dense"``: all are active
    """

    network: str
    name: str
    shape: tuple[int, ...]
    nnz: int
    parameters: int
    flops: int
    dense_flops: int
    in_budget: bool
    compute: str

    @classmethod
    def of(
        cls,
        network: str,
        name: str,
        shape: tuple[int, ...],
        *,
        nnz: int,
        biases: int = 0,
        behind: int = 0,
        positions: int = 0,
        in_budget: bool = False,
        is_sparse: bool = False,
    ) -> LayerReport:
        """Count parameters and FLOPs.

        :param biases: number of biases
        :param behind: FLOPs for each output of what comes behind the layer
        :param positions: output positions of a convolution, 1 for a linear layer; 0: not known
        :param is_sparse: whether the layer stores only its active connections
        """
        size = math.prod(shape)
        others = biases + shape[0] * behind
        return cls(
            network,
            name,
            shape,
            nnz,
            parameters=nnz + biases,
            flops=positions * (2 * nnz + others),
            dense_flops=positions * (2 * size + others),
            in_budget=in_budget,
            compute=SPARSE if is_sparse else MASKED if nnz < size else DENSE,
        )

    @property
    def size(self) -> int:
        """Connections of the dense layer."""
        return math.prod(self.shape)

    @property
    def density(self) -> float:
        """Active fraction."""
        return self.nnz / self.size


@dataclass(frozen=True)
class SparsityReport:
    """All layers of a policy, without target networks; ``print`` it for a table."""

    layers: tuple[LayerReport, ...]

    def sparsity(self, network: str | None = None) -> float:
        """Removed fraction of the weights within the budget, of one network or of all."""
        layers = [r for r in self.layers if r.in_budget and network in (None, r.network)]
        size = sum(r.size for r in layers)
        return 1.0 - sum(r.nnz for r in layers) / size if size else 0.0

    @property
    def nnz(self) -> int:
        """Active connections, layers left dense included."""
        return sum(r.nnz for r in self.layers)

    @property
    def parameters(self) -> int:
        """Active connections and biases, layers left dense included."""
        return sum(r.parameters for r in self.layers)

    def __str__(self) -> str:
        head = ("layer", "shape", "nnz", "density", "FLOPs", "of dense", "compute")
        rows = [
            (
                r.name,
                "x".join(map(str, r.shape)),
                f"{r.nnz:,}",
                f"{r.density:.4f}" if r.in_budget else "dense",
                *_costs(r.flops, r.dense_flops),
                r.compute,
            )
            for r in self.layers
        ]
        flops, dense = (sum(getattr(r, k) for r in self.layers) for k in ("flops", "dense_flops"))
        size = sum(r.size for r in self.layers)
        known = all(r.dense_flops for r in self.layers)
        total = ("total", "", f"{self.nnz:,}", f"{self.nnz / size:.4f}")
        rows.append((*total, *_costs(flops, dense if known else 0), ""))
        networks = list(dict.fromkeys(r.network for r in self.layers))
        summary = ", ".join(f"{name} {self.sparsity(name):.4f}" for name in networks)
        return "\n".join(
            [
                *table_lines([head, *rows]),
                f"sparsity: {summary}, total {self.sparsity():.4f}",
                f"parameters: {self.parameters:,} (active connections and biases)",
            ]
        )


def table_lines(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a text table: the first two columns to the left, numbers to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if i < 2 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def _costs(flops: int, dense_flops: int) -> tuple[str, str]:
    """FLOPs and their share of the dense ones, or question marks where these are not known."""
    return (f"{flops:,}", f"{flops / dense_flops:.3f}") if dense_flops else ("?", "?")


def build_report(policy: BasePolicy, networks: Iterable[SparseNetwork]) -> SparsityReport:
    """The report on a policy as it is now.

    :param policy: sparse or dense
    :param networks: its networks; those of a dense policy have all layers outside the budget
    """
    positions = conv_positions(policy)
    behind = flops_behind(policy)
    layers = []
    counted: set[int] = set()
    for network in networks:
        prunable: list[tuple[str, Prunable, tuple[int, ...], int, bool, bool]] = [
            (one.name, one.module, one.shape, one.nnz, True, one.is_sparse)
            for one in network.layers
        ]
        prunable += [
            (name, module, tuple(module.weight.shape), module.weight.numel(), False, False)
            for name, module in network.dense_layers
        ]
        for name, module, shape, nnz, in_budget, is_sparse in prunable:
            counted.add(id(module.weight))
            layers.append(
                LayerReport.of(
                    network.name,
                    name,
                    shape,
                    nnz=nnz,
                    biases=0 if module.bias is None else module.bias.numel(),
                    behind=behind.get(id(module), 0),
                    positions=positions.get(id(module), 1),
                    in_budget=in_budget,
                    is_sparse=is_sparse,
                )
            )
    return SparsityReport((*layers, *_other_matrices(policy, counted)))


def _other_matrices(policy: BasePolicy, counted: set[int]) -> list[LayerReport]:
    """Trained matrices outside Linear and Conv layers, which are dense: embeddings, for instance.

    A ``log_std`` is not counted, nor are target networks.

    :param counted: ids of the weights that the report has already
    """
    specs: Mapping[str, NetworkSpec] = getattr(policy, "networks", {})
    found = []
    for name, parameter in policy.named_parameters() if specs else ():
        if (
            parameter.dim() < 2
            or not parameter.requires_grad
            or id(parameter) in counted
            or name.rpartition(".")[2] == "log_std"
            or in_target(name, specs)
        ):
            continue
        within = [n for n, spec in specs.items() if name.startswith(spec.roots)]
        network, shape = (within or list(specs))[0], tuple(parameter.shape)
        found.append(LayerReport.of(network, name, shape, nnz=parameter.numel()))
    return found
