"""Exceptions: what a user can do wrong, said in one sentence that names the cure."""

from __future__ import annotations

import shlex
import sys
import warnings
from collections.abc import Iterable, Mapping
from difflib import get_close_matches

BETWEEN = {"sb3_sparse", "stable_baselines3", "sb3_contrib", "rl_zoo3", "optuna", "torch"}
"""Packages whose code may run between a line of the user's and the place that warns."""


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """What to add to a message on an unknown name: the nearest known one, or nothing.

    :param name: what was given, of any type
    :param known: what is allowed
    """
    by_spelling = {one.lower(): one for one in known}
    close = get_close_matches(str(name).lower(), by_spelling, n=1)
    return f" (did you mean {by_spelling[close[0]]!r}?)" if close else ""


def command(*words: object) -> str:
    """A command of this package, as a shell takes it: names with spaces are quoted."""
    return shlex.join(["sb3-sparse", *map(str, words)])


class SparsityError(Exception):
    """Base of every error that this package raises on purpose."""


class SparsityWarning(UserWarning):
    """Training goes on, but perhaps not as you meant it; the message says what to change."""


def warn(message: str) -> None:
    """Give a :class:`SparsityWarning` at the line of the user's code that led to it.

    Python prints that line below the message; one of this package or of SB3 would explain nothing.

    :param message: what happened, and what to change
    """
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and _package_of(frame.f_globals) in BETWEEN:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, SparsityWarning, stacklevel=level)


def _package_of(namespace: Mapping[str, object]) -> str:
    return str(namespace.get("__name__", "")).partition(".")[0]


class ConfigError(SparsityError, ValueError):
    """A value is outside of what is allowed; the message says what is."""


class RunBusy(ConfigError):
    """Another process is at work in a run's folder."""


class TuningFailed(SparsityError, RuntimeError):
    """No trial of a study came to its end."""


class Unwritable(SparsityError, OSError):
    """A disk is full, or a folder cannot be written to."""


class UnsupportedError(SparsityError, TypeError):
    """An algorithm, layer or space that sparse training does not cover."""


class Diverged(SparsityError, ArithmeticError):
    """A training whose networks hold values that are not finite."""


class CorruptStateError(SparsityError, RuntimeError):
    """A saved state contradicts itself or does not belong to this policy.

    No ``ValueError``: SB3's ``load`` takes that for a file of an old version of its own.
    """


class MissingExtra(SparsityError, ImportError):
    """An optional dependency is absent.

    :param what: what the user tried to do, e.g. ``"the command line"``
    :param extra: name of the extra that brings the dependency
    """

    def __init__(self, what: str, extra: str) -> None:
        super().__init__(f"{what} needs sb3-sparse[{extra}]: pip install 'sb3-sparse[{extra}]'")


class TopologyError(SparsityError, RuntimeError):
    """A topology method asked for an exchange that no mask allows."""


class MissingKernels(SparsityError, ImportError):
    """The compiled kernels that sparse storage needs are absent or do not fit.

    :param reason: what is wrong with them
    """

    def __init__(self, reason: str) -> None:
        super().__init__(
            f"sparse storage needs compiled kernels: {reason}. Reinstall sb3-sparse on a "
            "machine with a C compiler (gcc or clang), or use compute='masked'"
        )
