"""Runs Python code in forks of one process, so that what all of it imports is imported once."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

SERVER = """
import json, os, sys

first, codes = json.load(sys.stdin)
exec(first)
for number, code in enumerate(codes):
    os.mkdir(str(number))
    if os.fork() == 0:
        os.chdir(str(number))
        for stream, name in ((1, "out"), (2, "err")):
            os.dup2(os.open(f"../{number}.{name}", os.O_WRONLY | os.O_CREAT), stream)
        exec(code)
        sys.exit()
    _, status = os.wait()
    print(os.waitstatus_to_exitcode(status), flush=True)
"""


class Fork(NamedTuple):
    """What a fork ended with: its exit code, what it printed, and the folder that it ran in."""

    code: int
    out: str
    err: str
    folder: Path


def run_in_forks(first: str, codes: Sequence[str], folder: Path) -> list[Fork]:
    """Run each code in a fork with a folder of its own.

    :param first: code that runs once, before all of them
    :param folder: an empty folder
    """
    done = subprocess.run(
        [sys.executable, "-c", SERVER],
        cwd=folder,
        input=json.dumps([first, codes]),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return [
        Fork(
            int(code),
            (folder / f"{number}.out").read_text(),
            (folder / f"{number}.err").read_text(),
            folder / str(number),
        )
        for number, code in enumerate(done.stdout.split())
    ]
