"""Exceptions and warnings. Each message is one sentence that says what to do."""

from __future__ import annotations

import shlex
import sys
import sysconfig
import traceback
import warnings
from collections.abc import Collection, Iterable, Mapping
from difflib import get_close_matches
from pathlib import Path

HERE = Path(__file__).parent
BETWEEN = {"sb3_sparse", "stable_baselines3", "sb3_contrib", "rl_zoo3", "optuna", "torch"}
"""Packages whose code may run between a line of the user and the warning."""


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """The nearest known name, to be added to a message about an unknown one; empty if none.

    :param name: the unknown name, of any type
    :param known: allowed names
    """
    by_spelling = {one.lower(): one for one in known}
    close = get_close_matches(str(name).lower(), by_spelling, n=1)
    return f" (did you mean {by_spelling[close[0]]!r}?)" if close else ""


def check_choice(what: str, name: object, allowed: Collection[str], hint: str = "") -> None:
    """Check that a name is one of the allowed ones.

    :param what: kind of thing that has the name, e.g. ``"launcher"``
    :param name: the name, of any type
    :param allowed: all names, in the order to show them in
    :param hint: further text for the message
    :raises ConfigError: if the name is unknown
    """
    if not isinstance(name, str) or name not in allowed:
        raise ConfigError(
            f"unknown {what} {name!r}{did_you_mean(name, allowed)}; allowed are "
            f"{', '.join(allowed)}{hint}"
        )


def command(*words: object) -> str:
    """A command of this package for a shell, with words quoted where necessary."""
    return shlex.join(["sb3-sparse", *map(str, words)])


class SparsityError(Exception):
    """Base class of all errors that this package raises on purpose."""


class SparsityWarning(UserWarning):
    """Training continues, but perhaps not as intended; the message says what to change."""


def warn(message: str) -> None:
    """Issue a :class:`SparsityWarning` at the line of the user's code that led to it.

    Python prints that line below the message; a line of this package or of SB3 would not help.

    :param message: what happened, and what to change
    """
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and _package_of(frame.f_globals) in BETWEEN:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, SparsityWarning, stacklevel=level)


def _package_of(namespace: Mapping[str, object]) -> str:
    return str(namespace.get("__name__", "")).partition(".")[0]


def raised_here(error: BaseException) -> bool:
    """Whether this package's own code raised an error, rather than code that it called."""
    last = _last_file(error)
    # lazy.py raises for names that the user's code or settings ask for.
    return last is not None and last.is_relative_to(HERE) and last != HERE / "lazy.py"


def place_of(error: BaseException) -> str:
    """The file and line of the user's code that raised an error; empty for libraries."""
    while error.__cause__ is not None:
        error = error.__cause__
    last = _last_file(error)
    paths = sysconfig.get_paths()
    libraries = (HERE, *(Path(paths[name]) for name in ("stdlib", "purelib", "platlib")))
    if last is None or any(map(last.is_relative_to, libraries)):
        return ""
    return f" ({last}, line {traceback.extract_tb(error.__traceback__)[-1].lineno})"


def _last_file(error: BaseException) -> Path | None:
    """The file of the innermost frame; None without a traceback or without a file."""
    frames = traceback.extract_tb(error.__traceback__)
    known = frames and not frames[-1].filename.startswith("<")
    return Path(frames[-1].filename) if known else None


class ConfigError(SparsityError, ValueError):
    """A value is not allowed; the message says which are."""


class RunBusy(ConfigError):
    """Another process is using a run's folder."""


class TuningFailed(SparsityError, RuntimeError):
    """No trial of a search finished."""


class Unwritable(SparsityError, OSError):
    """A disk is full, or a folder is not writable."""


class UnsupportedError(SparsityError, TypeError):
    """Sparse training does not support an algorithm, layer or space."""


class Diverged(SparsityError, ArithmeticError):
    """Networks hold values that are not finite."""


class CorruptStateError(SparsityError, RuntimeError):
    """A saved state is inconsistent or does not belong to this policy.

    It is not a ``ValueError``, which SB3's ``load`` takes for a file of an old version.
    """


class MissingExtra(SparsityError, ImportError):
    """An optional dependency is not installed.

    :param what: what needs it, e.g. ``"the command line"``
    :param extra: name of the extra that installs it
    """

    def __init__(self, what: str, extra: str) -> None:
        super().__init__(f"{what} needs sb3-sparse[{extra}]: pip install 'sb3-sparse[{extra}]'")


class TopologyError(SparsityError, RuntimeError):
    """A topology method returned an exchange that the mask does not allow."""


class MissingKernels(SparsityError, ImportError):
    """The compiled kernels that sparse storage needs are absent or do not fit.

    :param reason: what is wrong with them
    """

    def __init__(self, reason: str) -> None:
        super().__init__(
            f"sparse storage needs compiled kernels: {reason}. Reinstall sb3-sparse on a "
            "machine with a C compiler (gcc or clang), or use compute='masked'"
        )
        self.reason = reason
