"""Random numbers by address: the same (seed, name, number) gives the same bits on any machine.

Nothing of it needs saving, and the global generators are never touched. Raw bits of a bit generator
are used because NumPy guarantees those streams, but not the distributions built on them.
"""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray


def random_bits(seed: int, address: str, count: int, number: int = 0) -> NDArray[np.uint64]:
    """``count`` uniform 64-bit integers.

    :param seed: the policy's mask seed, not negative
    :param address: what the numbers are for, e.g. ``"actor.mu/mask"``
    :param number: which use of the address, e.g. the optimizer step
    """
    digest = hashlib.sha256(address.encode()).digest()
    words = [int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4)]
    generator = np.random.PCG64(np.random.SeedSequence([seed, number, *words]))
    return np.asarray(generator.random_raw(count), dtype=np.uint64)


def random_uniform(seed: int, address: str, count: int, number: int = 0) -> NDArray[np.float64]:
    """``count`` numbers uniform in [-1, 1); the arguments are those of :func:`random_bits`."""
    bits = random_bits(seed, address, count, number)
    uniform: NDArray[np.float64] = (bits >> np.uint64(11)).astype(np.float64) * 2.0**-52 - 1.0
    return uniform
