"""What a program cannot do."""

from __future__ import annotations


class NotCovered(Exception):
    """A program cannot compute this, and SB3's own ``train()`` does. The message says what."""


class CheckFailed(Exception):
    """A run ended at a check; the message is the name of it."""
