"""Measures how long a policy takes to act, as C and by ``predict``."""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export.compiler import compiler
from sb3_sparse.export.observations import random_observations
from sb3_sparse.export.write import export_policy

OPTIONS = ("-std=c99", "-O3")
OBSERVATIONS = 64
ROUNDS = 15
BURST = 2e-3
"""Seconds of one burst."""
LOOP = """
#include <stdint.h>
#include <time.h>
void sb3_sparse_policy(const float *obs, float *action);
double seconds(const float *obs, float *action, uint32_t size, uint32_t rows, uint32_t count)
{
    struct timespec start, end;
    uint32_t i;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &start);
    for (i = 0; i < count; i++)
        sb3_sparse_policy(obs + (i % rows) * size, action);
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &end);
    return (double)(end.tv_sec - start.tv_sec) + 1e-9 * (double)(end.tv_nsec - start.tv_nsec);
}
"""
Burst = Callable[[int], float]
"""Runs a number of actions; returns the seconds for all."""


@dataclass(frozen=True)
class ActingCost:
    """What it costs to act with a policy.

    :param c: microseconds of an action of the C file, on one thread
    :param predict: microseconds of an action of ``model.predict``
    :param flash: bytes of the C file's constants; some 1 to 3 KB of code come on top
    :param dense_bytes: bytes of the float32 weights and biases of the same networks, dense
    """

    c: float
    predict: float
    flash: int
    dense_bytes: int


def acting_cost(model: BaseAlgorithm) -> ActingCost:
    """Export a policy to C in a temporary folder, check and compile it, and measure its actions.

    Both are measured in turn, in short bursts, on random observations. A time is the median over
    the bursts, in seconds of the thread: those of other processes do not count.

    :param model: a model whose observations are vectors
    :raises UnsupportedError: if there is no C compiler, or the policy cannot be exported to C
    :raises ParityError: if the C file does not act as the model
    """
    space = model.observation_space
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise UnsupportedError("actions are timed on vectors, and these observations are none")
    with tempfile.TemporaryDirectory() as folder:
        report = export_policy(model, Path(folder) / "policy", "c")
        observations = random_observations(space, model.get_vec_normalize_env(), OBSERVATIONS)
        library = with_loop(Path(folder) / "policy.c")
        in_c = c_burst(library, np.asarray(observations, np.float32), size_of(model))
        predict = looped(lambda row: model.predict(row, deterministic=True), observations)
        c, by_predict = map(median, measure([in_c, predict]))
    return ActingCost(1e6 * c, 1e6 * by_predict, report.sizes["flash"], report.dense_bytes)


def size_of(model: BaseAlgorithm) -> int:
    """Return how many numbers an action consists of in C."""
    return int(np.prod(model.action_space.shape or ()))


def looped(act: Callable[[Any], Any], observations: Sequence[Any]) -> Burst:
    """Make a burst of actions called from Python, one by one.

    :param act: takes one observation
    :param observations: taken in turn
    """

    def burst(count: int) -> float:
        start = time.thread_time()
        for i in range(count):
            act(observations[i % len(observations)])
        return time.thread_time() - start

    return burst


def with_loop(source: Path, options: tuple[str, ...] = OPTIONS, name: str = "") -> ctypes.CDLL:
    """Compile a policy in C with a loop around it, beside the file.

    :param source: the policy's ``.c`` file
    :param options: the compiler's
    :param name: of the library, without suffix; empty: the file's
    :raises UnsupportedError: if there is no compiler, or it fails
    """
    loop, library = source.with_name("loop.c"), source.with_name(f"{name or source.stem}.so")
    loop.write_text(LOOP)
    command = [*compiler(), *options, "-D_POSIX_C_SOURCE=199309L", "-shared", "-fPIC"]
    command += [str(source), str(loop), "-o", str(library), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise UnsupportedError(f"{command[0]} cannot compile the loop: {done.stderr.strip()}")
    return ctypes.CDLL(str(library))


def c_burst(library: ctypes.CDLL, rows: np.ndarray, actions: int) -> Burst:
    """Make a burst of actions called from C.

    :param library: of :func:`with_loop`
    :param rows: observations ``[count, size]``, float32, taken in turn
    :param actions: numbers that the policy writes
    """
    seconds = library.seconds
    seconds.restype = ctypes.c_double
    pointer = ctypes.POINTER(ctypes.c_float)
    action = np.empty(actions, np.float32)

    def burst(count: int) -> float:
        given, written = (one.ctypes.data_as(pointer) for one in (rows, action))
        return float(seconds(given, written, rows.shape[1], len(rows), count))

    return burst


def measure(bursts: Sequence[Burst], rounds: int = ROUNDS) -> list[list[float]]:
    """Measure the seconds of an action of each in turn, after a burst that sets the size of all.

    :return: for each burst, a time for each round
    """
    counts = []
    for burst in bursts:
        burst(20)
        counts.append(max(3, round(BURST / (burst(20) / 20))))
    times: list[list[float]] = [[] for _ in bursts]
    for _ in range(rounds):
        for burst, count, found in zip(bursts, counts, times, strict=True):
            burst(3)  # what the one before has pushed out of the cache
            found.append(burst(count) / count)
    return times
