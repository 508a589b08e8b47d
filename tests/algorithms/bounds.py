"""Trains with kernels that the address sanitizer watches; a program of test_bounds."""

from __future__ import annotations

import multiprocessing
import sys
from pathlib import Path

import torch as th
from algorithms_support import make

import sb3_sparse
from sb3_sparse.engine.native import library
from sb3_sparse.fused import tables

MODELS = [
    *(("SAC", "sparse"), ("DQN", "masked"), ("PPO", "masked")),
    *(("TQC", "sparse"), ("QRDQN", "masked"), ("CrossQ", "sparse")),
]
"""Algorithms and storages."""


def train(instructions: str) -> None:
    library.use(instructions)
    th.set_num_threads(2)
    for name, compute in MODELS:
        model = make(sb3_sparse, name, policy_kwargs=dict(sparsity=0.6, compute=compute))
        model.learn(48, callback=sb3_sparse.SparsityCallback("rigl", update_interval=4))
        assert model.why_not_fused() is None


def main() -> None:
    """Train in a process for each instruction set, since the first error ends it."""
    path, *broken = sys.argv[1:]
    library.PATH = Path(path)
    if broken:  # gradients and values by columns get less room than they need
        whole = tables._empty
        tables._empty = lambda count: whole(max(count - 24, 1))
    for instructions in library.instruction_sets():
        process = multiprocessing.get_context("fork").Process(target=train, args=[instructions])
        process.start()
        process.join()
        print(instructions, "fails" if process.exitcode else "is within bounds")


if __name__ == "__main__":
    main()
