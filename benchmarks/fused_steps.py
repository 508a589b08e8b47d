"""One gradient step: stock SB3's, that of stock SB3 with the sparse policy, and this package's own.

The three are timed in turn in one process, on one thread; the result is the median of the ratios
over the rounds. "plug-in" is ``stable_baselines3.SAC`` with ``SparsePolicy``, whose step is SB3's
own; "fused" is ``sb3_sparse.SAC``, whose step is one call of the kernels. The timing covers
``train()``, so each draws batches from its buffer.

    python benchmarks/fused_steps.py                             # two minutes
    python benchmarks/fused_steps.py --cases SAC --sparsity 0.9,0.95,0.99
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from statistics import median
from typing import Any, NamedTuple

import gymnasium as gym
import torch as th
from gymnasium import spaces
from random_env import TORQUES, VECTOR, RandomEnv
from rounds import interleaved, listed
from step_overhead import off_policy, on_policy

import sb3_sparse


class Case(NamedTuple):
    """A case: algorithm, width of its two layers or blocks, batch size."""

    algorithm: str
    width: int
    batch: int
    policy: str = "SparsePolicy"


CASES = {
    "SAC 256": Case("SAC", 256, 256),
    "SAC 64": Case("SAC", 64, 256),
    "TD3 256": Case("TD3", 256, 256),
    "DQN 512": Case("DQN", 512, 128),
    "TQC 256": Case("TQC", 256, 256),
    "QRDQN 256": Case("QRDQN", 256, 128),
    "CrossQ 256": Case("CrossQ", 256, 256),
    "CrossQ 1024": Case("CrossQ", 1024, 256),
    "PPO 64": Case("PPO", 64, 64),
    "SimBa SAC 128": Case("SAC", 128, 256, "SparseSimbaPolicy"),
    "SimBa SAC 256": Case("SAC", 256, 256, "SparseSimbaPolicy"),
}
SPARSITIES = [0.0, 0.9, 0.95]
STEPS = 20
"""Gradient steps in one timing."""


def make(algorithm: Any, case: Case, sparsity: float | None) -> Any:
    """Make a model; give a function that takes gradient steps, and their number too.

    :param algorithm: its class, stock's or this package's
    :param sparsity: None: SB3's own policy, or a dense SimBa network in SB3's own steps
    """
    actions = spaces.Discrete(4) if case.algorithm in ("DQN", "QRDQN") else TORQUES
    env: gym.Env = RandomEnv(VECTOR, actions)
    widths: Any = [case.width, case.width]
    if case.policy == "SparseSimbaPolicy":
        widths = {"pi": [case.width // 2], "qf": widths}
    if case.algorithm == "PPO":
        maker = on_policy(algorithm, env, case.batch, case.batch * STEPS, net_arch=widths)
    else:
        maker = off_policy(algorithm, env, case.batch, STEPS, net_arch=widths)
    if sparsity is not None:
        return maker(case.policy, {"sparsity": sparsity})
    if case.policy == "SparsePolicy":
        return maker("MlpPolicy", {})
    return maker(case.policy, {"sparsity": 0.0})  # SB3 has no such policy


def time_case(case: Case, sparsity: float, rounds: int) -> dict[str, dict[str, float]]:
    """Measure milliseconds per step and ratios to the others, by contender.

    :raises SystemExit: if our steps are not fused
    """
    stock = sb3_sparse.supported_algorithms()[case.algorithm]
    made = {
        "stock": make(stock, case, None),
        "plug-in": make(stock, case, sparsity),
        "fused": make(getattr(sb3_sparse, case.algorithm), case, sparsity),
    }
    why = made["fused"][0].why_not_fused()
    if why is not None:
        raise SystemExit(f"fused_steps: gradient steps are SB3's own: {why}")
    times = interleaved({name: train for name, (_, train, _) in made.items()}, rounds)

    def ratio(name: str, base: str) -> float:
        return median(one / other for one, other in zip(times[name], times[base], strict=True))

    return {
        name: {
            "ms": 1e3 * median(times[name]) / made[name][2],
            "stock": ratio(name, "stock"),
            "plug-in": ratio(name, "plug-in"),
        }
        for name in made
    }


def lines(cases: list[str], sparsities: list[float], rounds: int) -> Iterator[str]:
    """Yield the lines of a Markdown table."""
    yield "| step | sparsity | way | ms | share of stock's time | of the plug-in's |"
    yield "|---|---|---|---|---|---|"
    for name in cases:
        for sparsity in sparsities:
            for way, found in time_case(CASES[name], sparsity, rounds).items():
                yield (
                    f"| {name} | {sparsity:.0%} | {way} | {found['ms']:.3f} | {found['stock']:.3f} "
                    f"| {found['plug-in']:.3f} |"
                )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", default="", help="only the cases that contain this text")
    parser.add_argument("--sparsity", type=listed(float), default=SPARSITIES)
    parser.add_argument("--rounds", type=int, default=21, help="rounds of each case (default 21)")
    args = parser.parse_args()
    cases = [name for name in CASES if args.cases in name]
    if not cases:
        parser.error(f"--cases: none of {', '.join(CASES)} contains {args.cases!r}")
    th.set_num_threads(1)
    for line in lines(cases, args.sparsity, args.rounds):
        print(line, flush=True)


if __name__ == "__main__":
    main()
