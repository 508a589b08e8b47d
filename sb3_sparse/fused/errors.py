"""What a program cannot do."""

from __future__ import annotations


class NotCovered(Exception):
    """A program cannot compute this, and SB3's own ``train()`` does.

    :param reason: what it is, in a few words
    """

    def __init__(self, reason: str) -> None:
        super().__init__(
            f"the gradient steps of this model cannot be fused: {reason}. The page on gradient "
            "steps (docs/gradient_steps.md) lists what can be; Stable-Baselines3's own train() "
            "takes all of it"
        )
        self.reason = reason
