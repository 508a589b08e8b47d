"""A PostgreSQL server of the tests' own."""

from __future__ import annotations

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest

USER = "postgres"  # the server refuses to run as root
PASSWORD = "only-for-tests"  # noqa: S105


def programs() -> Path | None:
    """Where initdb and pg_ctl are."""
    found = shutil.which("initdb")
    if found is not None:
        return Path(found).parent
    debian = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    return debian[-1].parent if debian else None


@pytest.fixture(scope="session")
def postgres():
    """URL of an empty database."""
    bin = programs()
    if bin is None:
        pytest.skip("needs a PostgreSQL server: apt-get install postgresql")
    root = os.geteuid() == 0
    if root and USER not in {entry.pw_name for entry in pwd.getpwall()}:
        pytest.skip(f"PostgreSQL refuses to run as root, and there is no user {USER!r}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "password").write_text(PASSWORD)
        if root:
            shutil.chown(folder, USER)
            shutil.chown(folder / "password", USER)
        with served(bin, folder, USER if root else None) as port:
            yield f"postgresql://tuner:{PASSWORD}@127.0.0.1:{port}/postgres"


@contextmanager
def served(bin: Path, folder: Path, user: str | None):
    """Within it a server listens on the port that is yielded."""

    def run(*command: str) -> None:
        subprocess.run(command, check=True, user=user, cwd=folder, stdout=subprocess.DEVNULL)

    data, password = str(folder / "data"), str(folder / "password")
    run(str(bin / "initdb"), "-D", data, "-U", "tuner", "--pwfile", password, "-A", "md5")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    options = f"-h 127.0.0.1 -p {port} -k {folder} -c fsync=off"
    log = str(folder / "log")
    run(str(bin / "pg_ctl"), "-D", data, "-o", options, "-l", log, "-w", "start")
    try:
        yield port
    finally:
        run(str(bin / "pg_ctl"), "-D", data, "-m", "immediate", "stop")
