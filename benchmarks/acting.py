"""Networks on one observation, as in a rollout, for sparse_compute.py."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import torch as th
from compute_rows import rows_of
from gradient_steps import Case
from rounds import interleaved

from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.sequential import chain_up
from sb3_sparse.engine.structure import Structure

IMAGES = 20
"""Images in one timing, one after the other."""


def time_vectors(
    widths: list[int], sparsities: list[float], rounds: int
) -> Iterator[dict[str, Any]]:
    """Time the forward pass of three layers."""
    for width in widths:
        dense = th.nn.Sequential(
            *(th.nn.Linear(17, width), th.nn.ReLU()),
            *(th.nn.Linear(width, width), th.nn.ReLU()),
            th.nn.Linear(width, 6),
        )
        x = th.randn(1, 17)
        for sparsity in sparsities:
            random = np.random.default_rng(0)
            sparse = copy.deepcopy(dense)
            for module in sparse[::2]:
                flat = np.flatnonzero(random.random(module.weight.numel()) >= sparsity)
                shape = tuple(module.weight.shape)
                SparseLinear.convert(module, Structure(flat, shape), is_target=False)
            chain_up(sparse)

            @th.no_grad()
            def by(network: Callable[[th.Tensor], th.Tensor], x=x) -> None:
                for _ in range(200):
                    network(x)

            steps = {"dense": partial(by, dense), "sparse": partial(by, sparse)}
            times = interleaved(steps, rounds)
            yield from rows_of("one", f"17-{width}-{width}-6", 1, sparsity, times, 200)


def time_images(case: Case, sparsities: list[float], rounds: int) -> Iterator[dict[str, Any]]:
    """Time DQN's network on an image of bytes ("one"), and the policy's ``predict``."""
    image = np.asarray(case.env.observation_space.sample())
    batch = th.as_tensor(image)[None]

    def predict(model: Any) -> None:
        for _ in range(IMAGES):
            model.policy.predict(image, deterministic=True)

    @th.no_grad()
    def forward(model: Any) -> None:
        for _ in range(IMAGES):
            model.policy.q_net(batch)

    for sparsity in sparsities:
        models = {"dense, stock": case.make(case.dense)[0]}
        for compute in ("masked", "sparse", "auto"):
            models[compute] = case.make_sparse(sparsity, compute)[0]
        for model in models.values():
            model.policy.set_training_mode(False)
        for what, act in (("one", forward), ("predict", predict)):
            steps = {name: partial(act, model) for name, model in models.items()}
            times = interleaved(steps, rounds)
            yield from rows_of(what, case.name, 1, sparsity, times, IMAGES)
