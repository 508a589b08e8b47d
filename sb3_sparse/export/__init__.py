"""Policies that run elsewhere: C, NumPy, ONNX, and zips of stock SB3."""

from sb3_sparse.export.observations import record_observations
from sb3_sparse.export.parity import Parity, ParityError
from sb3_sparse.export.write import FORMATS, ExportReport, export

__all__ = ["FORMATS", "ExportReport", "Parity", "ParityError", "export", "record_observations"]
