"""Export policies as C, NumPy, ONNX, or zips of stock SB3."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sb3_sparse.lazy import lazily

if TYPE_CHECKING:
    from sb3_sparse.export.formats import FORMATS
    from sb3_sparse.export.observations import record_observations
    from sb3_sparse.export.parity import Parity, ParityError
    from sb3_sparse.export.report import ExportReport
    from sb3_sparse.export.returns import Returns
    from sb3_sparse.export.write import export_policy

__all__ = [
    "FORMATS",
    "ExportReport",
    "Parity",
    "ParityError",
    "Returns",
    "export_policy",
    "record_observations",
]
__getattr__, __dir__ = lazily(__name__)
