"""Makes trained models sparse, and finds how sparse they can be."""

from __future__ import annotations

from sb3_sparse.compress.result import Compression
from sb3_sparse.compress.run import compress_model
from sb3_sparse.compress.twin import sparsify

__all__ = ["Compression", "compress_model", "sparsify"]
