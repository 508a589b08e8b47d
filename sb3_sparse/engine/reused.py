"""Memory that is used again as soon as nothing refers to it."""

from __future__ import annotations

import torch as th

from sb3_sparse.engine.internals import use_count


class ReusedMemory:
    """Hands out float32 memory on the CPU, the same one once all who had it have let go of it.

    Memory more than twice as large as needed is given back.

    Fresh pages of a large block cost as much as the arithmetic on it, and torch returns large
    blocks to the system each time.
    """

    def __init__(self) -> None:
        self._blocks: list[tuple[th.Tensor, int]] = []

    def __call__(self, size: int) -> th.Tensor:
        """Return uninitialised memory.

        :param size: number of elements
        :return: shape ``(size,)``
        """
        if not size:
            return self._block(0)[0]  # a call that needs none leaves the block alone
        try:
            block, count = self._blocks.pop()  # no other thread sees it meanwhile
        except IndexError:
            block, count = self._block(size)
        if not size <= block.numel() <= 2 * size or use_count(block) > count:
            block, count = self._block(size)
        memory = block[:size]
        self._blocks[:] = [(block, count)]
        return memory

    @staticmethod
    def _block(size: int) -> tuple[th.Tensor, int]:
        block = th.empty(size, dtype=th.float32, device="cpu")
        return block, use_count(block)
