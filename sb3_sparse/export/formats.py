"""The names of the export formats, known without importing torch."""

from __future__ import annotations

from sb3_sparse.errors import ConfigError, did_you_mean

FORMATS = ("c", "numpy", "onnx", "dense")


def check_format(to: object) -> None:
    """Reject an unknown format.

    :raises ConfigError: if ``to`` is not one of :data:`FORMATS`
    """
    if to not in FORMATS:
        raise ConfigError(
            f"unknown export format {to!r}{did_you_mean(to, FORMATS)}; "
            f"allowed are {', '.join(FORMATS)}"
        )
