"""Random numbers by address: the same (seed, name, number) gives the same bits on any machine.

No state needs saving, and global generators stay untouched. The numbers are built from the raw bits
of a bit generator, whose stream NumPy guarantees, unlike that of its distributions.
"""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray


def random_bits(seed: int, address: str, count: int, number: int = 0) -> NDArray[np.uint64]:
    """Draw ``count`` uniform 64-bit integers.

    Example::

        from sb3_sparse.sparsity import random_bits

        random_bits(0, "actor.mu/grow", 3, number=1000)  # the same three on every machine

    :param seed: the policy's mask seed, not negative
    :param address: purpose of the numbers, e.g. ``"actor.mu/mask"``
    :param count: how many
    :param number: distinguishes uses of one address, e.g. the optimizer step
    """
    digest = hashlib.sha256(address.encode()).digest()
    words = [int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4)]
    generator = np.random.PCG64(np.random.SeedSequence([seed, number, *words]))
    return np.asarray(generator.random_raw(count), dtype=np.uint64)


def random_uniform(seed: int, address: str, count: int, number: int = 0) -> NDArray[np.float64]:
    """Draw ``count`` numbers uniform in [-1, 1); for the arguments see :func:`random_bits`."""
    bits = random_bits(seed, address, count, number)
    uniform: NDArray[np.float64] = (bits >> np.uint64(11)).astype(np.float64) * 2.0**-52 - 1.0
    return uniform
