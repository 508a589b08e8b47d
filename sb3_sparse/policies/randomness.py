"""A seed of masks that follows SB3's own."""

from __future__ import annotations

import torch as th


def peek_seed() -> int:
    """The next number of torch's global generator, which is left where it is."""
    generator = th.Generator()
    generator.set_state(th.get_rng_state())
    return int(th.randint(2**63 - 1, (), generator=generator))
