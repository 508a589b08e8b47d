"""The error for what a program cannot compute."""

from __future__ import annotations


class NotCovered(Exception):
    """A program cannot compute this, so SB3's own ``train()`` must.

    Example::

        from sb3_sparse.fused import NotCovered

        str(NotCovered("gSDE"))  # "the gradient steps of this model cannot be fused: gSDE. ..."

    :param reason: the feature, in a few words
    """

    def __init__(self, reason: str) -> None:
        super().__init__(
            f"the gradient steps of this model cannot be fused: {reason}. The page on gradient "
            "steps (docs/gradient_steps.md) lists what can be fused; Stable-Baselines3's own "
            "train() supports everything"
        )
        self.reason = reason
