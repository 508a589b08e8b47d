"""Prints MuJoCo's warnings about Gymnasium's models once, not each time a model is made."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import Any

import gymnasium as gym

_said: set[str] = set()


@contextmanager
def mujoco_warns_once(env_id: str) -> Iterator[None]:
    """Print each of MuJoCo's warnings once per process, and write none to a file.

    Outside, MuJoCo prints them all and writes ``MUJOCO_LOG.TXT`` into the current folder.

    :param env_id: environment to make; MuJoCo is imported only if this is one of Gymnasium's own
        MuJoCo tasks
    """
    entry_point = str(getattr(gym.registry.get(env_id), "entry_point", ""))
    mujoco: Any = sys.modules.get("mujoco")
    if mujoco is None and "mujoco" in entry_point:
        with suppress(ImportError):  # Gymnasium reports what is missing
            mujoco = import_module("mujoco")
    if mujoco is None:
        yield
        return

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_say)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _say(message: str) -> None:
    message = message.strip()
    if message not in _said:
        _said.add(message)
        print(f"MuJoCo warns: {message}", file=sys.stderr)
