"""What an export tells the user."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sb3_sparse.export.parity import Parity
from sb3_sparse.export.returns import Returns


@dataclass(frozen=True)
class ExportReport:
    """The outcome of an export.

    :param files: the files and their sizes in bytes
    :param parity: how closely the export acts as the model; None: not checked
    :param rounding: how much 8-bit numbers change the actions; None: there are none
    :param returns: what they do to the return; None: not played
    :param sizes: bytes needed where the policy runs, by kind (``"flash"``, ``"RAM"``)
    :param notes: what the user must know
    :param nnz: connections of the exported networks that are not 0; for ``"dense"``, of all
        networks
    :param exported_nnz: those left once dead units are removed
    :param dense_bytes: float32 weights and biases of these networks if they were dense; 0 for
        ``"dense"``, as the counts of units
    :param removed_units: number of dead units
    :param units: number of units before

    Example::

        from stable_baselines3 import PPO
        from sb3_sparse.export import export_policy

        model = PPO("SparsePolicy", "CartPole-v1", policy_kwargs=dict(sparsity=0.9))
        print(export_policy(model, "policy", to="numpy"))
    """

    files: dict[Path, int]
    parity: Parity | None
    rounding: Parity | None
    sizes: dict[str, int]
    notes: tuple[str, ...]
    nnz: int
    exported_nnz: int
    dense_bytes: int = 0
    removed_units: int = 0
    units: int = 0
    returns: Returns | None = None

    def __str__(self) -> str:
        lines = [f"{path}: {size:,} bytes" for path, size in self.files.items()]
        lines += [f"{kind}: {size:,} bytes" for kind, size in self.sizes.items()]
        if self.dense_bytes:
            lines.append(f"float32 weights of the dense network: {self.dense_bytes:,} bytes")
            lines.append(
                f"connections: {self.nnz:,}, exported {self.exported_nnz:,}; "
                f"{self.removed_units} of {self.units} units were dead and are left out"
            )
        else:
            lines.append(f"connections that are not 0: {self.nnz:,}")
        lines.append(f"parity: {'not checked' if self.parity is None else self.parity}")
        if self.rounding is not None:
            lines.append(f"int8 against float32: {self.rounding}")
        if self.returns is not None:
            lines.append(f"return: {self.returns}")
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])
