"""The names of the export formats, known without importing torch."""

from __future__ import annotations

from sb3_sparse.errors import check_choice

FORMATS = ("c", "numpy", "onnx", "dense")


def check_format(to: object) -> None:
    """Reject an unknown format.

    :raises ConfigError: if ``to`` is not one of :data:`FORMATS`
    """
    check_choice("export format", to, FORMATS)
