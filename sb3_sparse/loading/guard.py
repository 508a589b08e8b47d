"""Turns errors while a file is read into errors that name the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sb3_sparse.errors import ConfigError, CorruptStateError, SparsityError, UnsupportedError


@contextmanager
def reading(path: Path, what: str, cure: str) -> Iterator[None]:
    """Turn every error of a library that reads the file into one of this package.

    Damaged bytes make a parser raise anything at all, so everything is caught. Keep the block to
    the reading itself: bugs of this package must still show a traceback.

    :param path: the file
    :param what: what the file should hold, e.g. ``"record of a run"``
    :param cure: what to do if it does not
    :raises ConfigError: if the file cannot be opened, or needs code that is not installed
    :raises CorruptStateError: if the file holds something else
    """
    try:
        yield
    except (ConfigError, CorruptStateError, UnsupportedError) as error:
        if str(path) in str(error):
            raise
        raise type(error)(f"{path}: {error}") from error
    except SparsityError:
        raise
    except FileNotFoundError as error:
        raise ConfigError(f"there is no file {path}; {cure}") from error
    except (PermissionError, IsADirectoryError) as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}; {cure}") from error
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"{path} needs the module {error.name!r}, which cannot be imported; install it, "
            "or run the command in its folder. If the model has no code of its own, the file is "
            f"damaged: {cure}"
        ) from error
    except MemoryError as error:
        raise CorruptStateError(
            f"{path} is damaged: it asks for more memory than there is; {cure}"
        ) from error
    except Exception as error:
        raise CorruptStateError(
            f"{path} is damaged, or holds no {what} ({reason(error)}); {cure}"
        ) from error


def reason(error: BaseException) -> str:
    """Return an error's message as a line of readable length."""
    text = " ".join(str(error).split())
    text = "".join(c if c.isprintable() else "�" for c in text)
    name = type(error).__name__
    if len(text) > 200:
        text = text[:200] + "..."
    return f"{name}: {text}" if text else name
