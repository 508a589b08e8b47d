"""Replay buffers."""

from sb3_sparse.buffers.dynamic import DynamicReplayBuffer

__all__ = ["DynamicReplayBuffer"]
