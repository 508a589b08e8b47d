"""The names of the export formats, known without importing torch."""

from __future__ import annotations

from sb3_sparse.errors import ConfigError, check_choice

FORMATS = ("c", "numpy", "onnx", "dense")
INT8 = ("weights", "full")
"""What 8-bit weights may be combined with: float32 values, or whole numbers throughout."""


def check_format(to: object) -> None:
    """Reject an unknown format.

    :raises ConfigError: if ``to`` is not one of :data:`FORMATS`
    """
    check_choice("export format", to, FORMATS)


def check_int8(int8: object, to: str) -> str | None:
    """Return what is stored as 8-bit numbers; None: nothing.

    :param int8: one of :data:`INT8`, True for ``"weights"``, False or None for nothing
    :param to: the format
    :raises ConfigError: for another value, or a format that has no 8-bit weights
    """
    if int8 is None or int8 is False:
        return None
    chosen = "weights" if int8 is True else int8
    check_choice("value of int8", chosen, INT8)
    if to != "c":
        raise ConfigError(f"int8 is for to='c' only, got to={to!r}")
    return str(chosen)


def check_outputs(to: str, with_value: bool, stochastic: bool, int8: object = False) -> None:
    """Reject further outputs of a format that has none.

    :raises ConfigError: for ``"dense"``, and for ``int8="full"``
    """
    if not (with_value or stochastic):
        return
    asked = "with_value" if with_value else "stochastic"
    if int8 == "full":
        raise ConfigError(
            f"int8='full' is for the action alone, so it cannot be combined with {asked}; give "
            "int8='weights' (--int8 weights), or leave one of them out"
        )
    if to == "dense":
        raise ConfigError(
            f"{asked} is for c, numpy and onnx, got to='dense': a zip of SB3 has its critics and "
            "distributions anyway; load it, and call its policy"
        )
