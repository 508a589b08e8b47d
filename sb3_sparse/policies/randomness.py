"""A seed for masks that follows from SB3's own."""

from __future__ import annotations

import torch as th


def peek_seed() -> int:
    """The next number of torch's global generator, without advancing it."""
    generator = th.Generator()
    generator.set_state(th.get_rng_state())
    return int(th.randint(2**63 - 1, (), generator=generator))
