"""Classes of buffers that settings name."""

from __future__ import annotations

from typing import Any

from sb3_sparse.policies.arguments import import_classes

BUFFERS = ("replay_buffer_class", "rollout_buffer_class")


def import_buffers(settings: dict[str, Any]) -> None:
    """Replace dotted paths of buffers by their classes, in place.

    A replay buffer may also have one of the bare names that rl-zoo knows, ``HerReplayBuffer``.

    :raises ConfigError: if there is no such class
    """
    bare = str(settings.get("replay_buffer_class")).isidentifier()
    import_classes(settings, BUFFERS[1:] if bare else BUFFERS)
