"""What a program cannot do."""

from __future__ import annotations


class NotCovered(Exception):
    """A program cannot compute this, and SB3's own ``train()`` does. The message says what."""
