"""The forms that a policy can be exported to, by name."""

from __future__ import annotations

from sb3_sparse.errors import ConfigError, did_you_mean

FORMATS = ("c", "numpy", "onnx", "dense")


def check_format(to: object) -> None:
    """Refuse a form that there is not.

    :raises ConfigError: if so
    """
    if to not in FORMATS:
        raise ConfigError(
            f"to must be one of {', '.join(map(repr, FORMATS))}, got {to!r}"
            f"{did_you_mean(to, FORMATS)}"
        )
