"""The stock zoo's own commands, each series in a process that has imported the zoo already."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rl_zoo3.enjoy import enjoy
from rl_zoo3.train import train

from sb3_sparse.launch import Task, launcher_named

COMMANDS = {"train": train, "enjoy": enjoy}


@dataclass(frozen=True)
class Ended:
    """What a series of commands said, and the traceback of one that failed."""

    said: str
    error: str | None


def run(folder: Path, series: Sequence[Sequence[str]]) -> None:
    """Run the commands in this process."""
    os.chdir(folder)
    for command, *arguments in series:
        sys.argv = [f"rl_zoo3.{command}", *arguments]
        COMMANDS[command]()


def run_zoo(folder: Path, many: Mapping[str, Sequence[Sequence[str]]]) -> dict[str, Ended]:
    """Run each series in a process and a folder of its own."""
    tasks = []
    for name, series in many.items():
        (folder / name).mkdir(exist_ok=True)
        arguments = {"folder": folder / name, "series": series}
        tasks.append(Task(name, "zoo_support:run", arguments, folder / f"{name}.log"))
    results = [one for one in launcher_named("local").run(tasks, 1) if one is not None]
    return {one.task.name: Ended(one.task.log.read_text(), one.error) for one in results}
