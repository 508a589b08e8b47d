"""Numbers as a reader wants them: few digits, and no more exponents than needed."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

DIGITS = 2
PLAIN = range(-3, 7)  # powers of ten of the numbers that are written without an exponent


def short(value: float, digits: int = DIGITS) -> str:
    """Round to significant digits, e.g. ``"-150"`` for -154.03, and ``"1e-6"``.

    :param digits: 1 or more; zeros at the end of a fraction are dropped
    """
    if not math.isfinite(value):
        return str(value)
    rounded = f"{value + 0.0:.{digits - 1}e}"  # -0.0 becomes 0.0
    mantissa, power = rounded.split("e")
    if int(power) in PLAIN:
        decimals = max(0, digits - 1 - int(power))
        return _trimmed(f"{float(rounded):,.{decimals}f}")
    return f"{_trimmed(mantissa)}e{int(power)}"


def shorten(values: Sequence[float]) -> list[str]:
    """Round numbers that are compared to two digits, or to three where two would tie.

    :return: a text for each value
    """
    for digits in (DIGITS, DIGITS + 1):
        texts = [short(value, digits) for value in values]
        if len(set(texts)) == len(set(values)):
            break
    return texts


def counted(number: int, thing: str) -> str:
    """Write how many there are of a thing, e.g. ``"1 seed"`` and ``"1,000 seeds"``."""
    return f"{number:,} {thing}" + ("s" if number != 1 else "")


def counted_between(numbers: Collection[int], thing: str) -> str:
    """Write the least and the greatest of several counts, e.g. ``"3 to 5 seeds"``."""
    low, high = min(numbers), max(numbers)
    return f"{low:,} to {counted(high, thing)}" if low < high else counted(high, thing)


def _trimmed(text: str) -> str:
    return text.rstrip("0").rstrip(".") if "." in text else text
