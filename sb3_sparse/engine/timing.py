"""How long a linear layer takes masked and compact on this machine; measured once, remembered."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional

from sb3_sparse.engine.chains import Chain
from sb3_sparse.engine.linear import CompactLinear
from sb3_sparse.engine.native.library import PATH, in_use
from sb3_sparse.engine.products import TILE, tiles_of
from sb3_sparse.engine.structure import Structure

PLAIN: Any = dict(dtype=th.float32, device="cpu")  # whatever torch's defaults are
ROUNDS = 5
SECONDS_A_ROUND = 0.002


@dataclass(frozen=True)
class Timing:
    """Seconds of one layer's forward and backward pass and gradient mask; without the optimizer.

    :param masked: dense weights and a mask
    :param compact: active connections only, activations in tiles before and after
    :param conversion: on top of that, from and to rows of the batch
    """

    masked: float
    compact: float
    conversion: float


_known: dict[str, Timing] = {}


def timing_of(shape: tuple[int, int], nnz: int, batch: int) -> Timing:
    """The timing of a ``(rows, columns)`` layer, out of the cache or measured now.

    :param nnz: active connections; two digits of it count
    :param batch: entries of a minibatch
    """
    digits = 10 ** max(0, len(str(nnz)) - 2)
    nnz = min(max(1, round(nnz / digits) * digits), shape[0] * shape[1])
    built = int(PATH.stat().st_mtime)  # other kernels, other timings
    machine = (_processor(), in_use(), built, th.get_num_threads(), th.__version__)
    key = "|".join(map(str, (*machine, *shape, nnz, batch)))
    if key not in _known:
        _known.update(_read())
    if key not in _known:
        with th.inference_mode(False), th.autocast("cpu", enabled=False):
            _known[key] = _measure(shape, nnz, batch)
        _write()
    return _known[key]


def _measure(shape: tuple[int, int], nnz: int, batch: int) -> Timing:
    rows, columns = shape
    random = np.random.default_rng(0)
    flat = np.sort(random.choice(rows * columns, nnz, replace=False))
    weight = th.from_numpy(random.standard_normal((rows, columns), dtype=np.float32))
    inputs = th.from_numpy(random.standard_normal((batch, columns), dtype=np.float32))
    with th.random.fork_rng(devices=[]):
        masked, twin = (nn.Linear(columns, rows, **PLAIN) for _ in range(2))
    with th.no_grad():
        masked.weight.copy_(weight)
        twin.weight.copy_(weight)
    compact = CompactLinear.convert(twin, Structure(flat, shape), is_target=False)
    mask = th.ones(rows, columns, **PLAIN)
    chain = Chain([compact], [True])
    tiles = th.zeros(tiles_of(batch), columns, TILE, **PLAIN)

    def by_mask(x: th.Tensor) -> th.Tensor:
        return functional.relu(functional.linear(x, masked.weight, masked.bias))

    def in_tiles(x: th.Tensor) -> th.Tensor:
        return chain.run(x, batch, True, True)

    def from_rows(x: th.Tensor) -> th.Tensor:
        return chain.run(x, batch, False, False)

    steps = [
        _step(by_mask, inputs, masked, mask),
        _step(in_tiles, tiles, compact, None),
        _step(from_rows, inputs, compact, None),
    ]
    by, tiled, plain = _interleaved(steps)
    return Timing(by, tiled, max(0.0, plain - tiled))


def _step(
    forward: Callable[[th.Tensor], th.Tensor],
    x: th.Tensor,
    module: nn.Linear,
    mask: th.Tensor | None,
) -> Callable[[], None]:
    """Forward, backward, mask on the gradient."""
    x = x.requires_grad_(True)
    with th.enable_grad():
        grad = th.ones_like(forward(x))

    def step() -> None:
        with th.enable_grad():
            y = forward(x)
        parameters = [x, module.weight, module.bias]
        _, weight_grad, _ = th.autograd.grad(y, parameters, grad)
        if mask is not None:
            weight_grad.mul_(mask)

    return step


def _interleaved(steps: list[Callable[[], None]]) -> list[float]:
    """Least seconds of each step, timed in turn: what a busy machine adds decides nothing."""
    repeats = []
    for step in steps:
        step()
        start = time.perf_counter()
        step()
        repeats.append(max(1, int(SECONDS_A_ROUND / (time.perf_counter() - start))))
    times: list[list[float]] = [[] for _ in steps]
    for _ in range(ROUNDS):
        for step, count, found in zip(steps, repeats, times, strict=True):
            start = time.perf_counter()
            for _ in range(count):
                step()
            found.append((time.perf_counter() - start) / count)
    return [min(found) for found in times]


@cache
def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def cache_path() -> Path:
    """The file that remembers timings; delete it to have them measured again."""
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root, "sb3_sparse", "timings.json")


def _read() -> dict[str, Timing]:
    try:
        found: dict[str, Any] = json.loads(cache_path().read_text())
        return {key: Timing(**{k: float(v) for k, v in t.items()}) for key, t in found.items()}
    except (OSError, RuntimeError, ValueError, TypeError, AttributeError):
        return {}  # there is none, or it is damaged: measured again and written anew


def _write() -> None:
    whole = {**_read(), **_known}
    try:
        path = cache_path()
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = path.with_name(f"{path.name}.{os.getpid()}")
        draft.write_text(json.dumps({key: asdict(timing) for key, timing in whole.items()}))
        draft.replace(path)
    except (OSError, RuntimeError):
        pass  # no home, or one that cannot be written to: measured again next time
