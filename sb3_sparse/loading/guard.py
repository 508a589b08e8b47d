"""Whatever goes wrong while a file is read is said of the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sb3_sparse.errors import ConfigError, CorruptStateError, SparsityError, UnsupportedError


@contextmanager
def reading(path: Path, what: str, cure: str) -> Iterator[None]:
    """Within it, every error of a library that reads the file becomes one of ours.

    Damaged bytes make a parser raise anything at all, so all of it is caught. Keep the block to the
    reading itself: our own mistakes must still show a traceback.

    :param path: of the file
    :param what: it should hold, e.g. ``"record of a run"``
    :param cure: what to do if it does not
    :raises ConfigError: if it cannot be opened, or needs code that is not here
    :raises CorruptStateError: if its content is not what it should be
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
            f"{path} needs the module {error.name!r}, which cannot be imported here; install it, "
            "or run the command where it lies. If the model has no code of its own, the file is "
            f"damaged: {cure}"
        ) from error
    except MemoryError as error:
        raise CorruptStateError(
            f"{path} is damaged: it asks for more memory than there is; {cure}"
        ) from error
    except Exception as error:
        raise CorruptStateError(
            f"{path} is damaged, or is no {what} ({reason(error)}); {cure}"
        ) from error


def reason(error: BaseException) -> str:
    """What an error says, in a line of readable length."""
    text = " ".join(str(error).split())
    text = "".join(c if c.isprintable() else "�" for c in text)
    name = type(error).__name__
    if len(text) > 200:
        text = text[:200] + "..."
    return f"{name}: {text}" if text else name
