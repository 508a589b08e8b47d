"""Registers the tasks of dm_control (the DeepMind Control Suite), which shimmy wraps."""

from __future__ import annotations

import importlib.util
import warnings

import gymnasium as gym

PREFIX = "dm_control/"


def register_dm_control() -> bool:
    """Register dm_control's tasks if it and shimmy are installed, and return whether they are."""
    if any(importlib.util.find_spec(name) is None for name in ("shimmy", "dm_control")):
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # glfw warns where there is no display
        import shimmy

        _forget_absent_fields()
    gym.register_envs(shimmy)
    return True


def _forget_absent_fields() -> None:
    """Let dm_control run with a later MuJoCo than the one it was made for.

    It lists MuJoCo's arrays by name and reads them all when it loads a model. A later MuJoCo may
    have dropped some (4.0: those of flexes, which no task of the suite has).
    """
    import mujoco
    from dm_control.mujoco.wrapper.mjbindings.sizes import array_sizes

    for struct, arrays in (("mjmodel", mujoco.MjModel), ("mjdata", mujoco.MjData)):
        known = array_sizes[struct]
        for name in [name for name in known if not hasattr(arrays, name)]:
            del known[name]
