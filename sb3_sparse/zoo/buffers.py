"""Classes of buffers that settings name."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer

from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.arguments import import_path

BUFFERS = {"replay_buffer_class": ReplayBuffer, "rollout_buffer_class": RolloutBuffer}
HER = "HerReplayBuffer"
"""The buffer that rl-zoo knows by its bare name."""


def import_buffers(settings: dict[str, Any]) -> None:
    """Replace dotted paths of buffers by their classes, in place.

    :raises ConfigError: if there is no such class, or if it is no such buffer
    """
    for name, kind in BUFFERS.items():
        path = settings.get(name)
        if not isinstance(path, str) or path == HER:
            continue
        try:
            found = import_path(path)
        except ImportError as error:
            raise ConfigError(
                f"{name}={path!r} cannot be imported ({error}); give a dotted path, e.g. "
                f"{kind.__module__}.{kind.__name__}"
            ) from error
        if not (isinstance(found, type) and issubclass(found, kind)):
            raise ConfigError(
                f"{name}={path!r} is not a subclass of {kind.__module__}.{kind.__name__}; make it "
                "one"
            )
        settings[name] = found
