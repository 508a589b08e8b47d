"""URLs of storages: parsed, and shown without their passwords."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from sb3_sparse.errors import ConfigError

DATABASES = ("sqlite", "postgresql", "mysql", "mariadb", "mssql")


def is_journal(storage: str | Path) -> bool:
    """Return whether a storage is a path, i.e. a journal file.

    :raises ConfigError: for something between a path and a URL, e.g. a URL with one slash, whose
        password would become the name of a folder
    """
    text = str(storage)
    if not isinstance(storage, Path) and "://" in text:
        return False
    on_windows = re.match(r"[A-Za-z]:[\\/]", text)
    rest = text[2:] if on_windows else text
    scheme = re.match(r"\s*([A-Za-z][A-Za-z0-9+.-]*):", rest)
    if (scheme or re.search(r":.*@", rest)) and not Path(text).exists():
        name = scheme.group(1) if scheme and scheme.group(1).split("+")[0] in DATABASES else ""
        raise ConfigError(
            f"the storage {f'{name}:...' if name else 'of this form'} looks like a URL, but "
            "is not one; give a path (a journal file) or a URL as text, with its two or three "
            "slashes: sqlite:///file.db, postgresql://user:password@host:5432/database, mysql://..."
        )
    return True


def file_of(storage: str | Path) -> Path | None:
    """Return the file of a journal or an SQLite database; None for a server."""
    if is_journal(storage):
        return Path(storage)
    url = url_of(str(storage))
    return Path(url.database or "") if url.get_backend_name() == "sqlite" else None


def shown_url(storage: str | Path) -> str:
    """Return a storage as text without its password.

    :raises ConfigError: if it is not a storage
    """
    if is_journal(storage):
        return str(storage)
    url = url_of(str(storage))
    hidden = {
        name: "hidden" if "pass" in name.lower() else value for name, value in url.query.items()
    }
    return str(url.set(query=hidden).render_as_string(hide_password=True))


def url_of(storage: str) -> Any:
    """Parse a URL of SQLAlchemy's; PostgreSQL gets the driver of the extra ``postgres``.

    :raises ConfigError: for another kind of storage, or a malformed URL; shows its scheme only
    """
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import ArgumentError

    scheme, _, rest = storage.partition("://")
    shown = f"{scheme}://..." if scheme.replace("+", "").isalnum() else "of this form"
    if rest.count("@") > 1:
        raise ConfigError(
            f"the storage {shown} has more than one @; write an @ in a password as %40, a : as %3A "
            "and a / as %2F"
        )
    try:
        url = make_url(storage)
        known = url.get_backend_name() in DATABASES
        known = known and "@" not in (url.host or "")
    except (ArgumentError, ValueError):  # their texts may hold the password
        known = False
    if not known:
        raise ConfigError(
            f"the storage {shown} is unknown, or the rest of its URL is malformed; allowed "
            "are a path (a journal file) and URLs of SQLAlchemy: sqlite:///file.db, "
            "postgresql://user:password@host:5432/database, mysql://..."
        ) from None
    if url.get_backend_name() == "sqlite" and not url.database:
        raise ConfigError(
            "the storage sqlite:// lives in a single process, but workers are processes of their "
            "own; name a file, e.g. sqlite:///studies.db"
        )
    if url.drivername == "postgresql":
        url = url.set(drivername="postgresql+psycopg")
    return url
