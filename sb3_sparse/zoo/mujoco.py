"""MuJoCo says the same of Gymnasium's models each time one is made; here it says it once."""

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
    """Within it, each of MuJoCo's warnings is printed once a process, and none goes to a file.

    Otherwise it prints them all and writes ``MUJOCO_LOG.TXT`` into the current folder. Afterwards
    it does so again.

    :param env_id: what is made; only for Gymnasium's own MuJoCo tasks, and where MuJoCo is loaded
        already, is it asked for
    """
    entry_point = str(getattr(gym.registry.get(env_id), "entry_point", ""))
    mujoco: Any = sys.modules.get("mujoco")
    if mujoco is None and "mujoco" in entry_point:
        with suppress(ImportError):  # Gymnasium says what is missing
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
