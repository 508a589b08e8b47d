"""Cost of one masked gradient step, as a ratio to stock dense Stable-Baselines3.

All variants of a case are timed in turn in one process, so that a slow phase of the machine slows
all of them; the result is the median of the ratios over the rounds.

    python benchmarks/step_overhead.py            # about five minutes
    python benchmarks/step_overhead.py --rounds 5 --cases SAC
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import gymnasium as gym
import torch as th
from gymnasium import spaces
from random_env import IMAGE, TORQUES, VECTOR, RandomEnv
from rounds import interleaved
from stable_baselines3 import DQN, PPO, SAC

import sb3_sparse  # noqa: F401  (registers SparsePolicy)
from sb3_sparse import SparsityCallback

SPARSITY = 0.9


def off_policy(algo: Any, env: gym.Env, batch: int, steps: int, **settings: Any) -> Callable:
    """Make a function that creates models whose ``train`` takes ``steps`` gradient steps."""

    def make(policy: str, policy_kwargs: dict[str, Any]) -> tuple[Any, Callable[[], None], int]:
        model = algo(
            policy, env, seed=0, learning_starts=600, buffer_size=1000, batch_size=batch,
            policy_kwargs={**settings, **policy_kwargs},
        )  # fmt: skip
        model.learn(600)
        return model, lambda: model.train(gradient_steps=steps, batch_size=batch), steps

    return make


def on_policy(algo: Any, env: gym.Env, batch: int, rollout: int, **settings: Any) -> Callable:
    """As :func:`off_policy`, for PPO: one call is an epoch over a rollout."""

    def make(policy: str, policy_kwargs: dict[str, Any]) -> tuple[Any, Callable[[], None], int]:
        model = algo(
            policy, env, seed=0, n_steps=rollout, batch_size=batch, n_epochs=1,
            policy_kwargs={**settings, **policy_kwargs},
        )  # fmt: skip
        model.learn(rollout)
        return model, model.train, rollout // batch

    return make


CASES: dict[str, tuple[Callable, str, float]] = {
    "SAC 256x256 batch 256": (off_policy(SAC, RandomEnv(VECTOR, TORQUES), 256, 10), "Mlp", 0.97),
    "DQN 512x512 batch 128": (
        off_policy(DQN, RandomEnv(VECTOR, spaces.Discrete(4)), 128, 30, net_arch=[512, 512]),
        "Mlp",
        0.90,
    ),
    "PPO 64x64 batch 64": (on_policy(PPO, RandomEnv(VECTOR, TORQUES), 64, 2048), "Mlp", 0.90),
    "DQN Nature CNN batch 32": (
        off_policy(DQN, RandomEnv(IMAGE, spaces.Discrete(6)), 32, 5),
        "Cnn",
        0.95,
    ),
}
FUSED = dict(optimizer_kwargs=dict(fused=True))
SPARSE = dict(sparsity=SPARSITY, compute="masked")  # sparse_compute.py times the other storage


def fused_like_stock(model: Any) -> dict[str, Any]:
    """Make stock policy arguments with SB3's own optimizer, fused."""
    return dict(optimizer_kwargs={**model.policy.optimizer_kwargs, "fused": True})


def time_case(name: str, rounds: int) -> dict[str, tuple[float, float]]:
    """Measure milliseconds per step and the ratio to stock, by variant."""
    make, kind, _ = CASES[name]
    stock = make(f"{kind}Policy", {})
    eager = {**stock[0].policy.optimizer_kwargs, "fused": False}
    variants = {
        "dense, stock": stock,
        "dense, fused Adam": make(f"{kind}Policy", fused_like_stock(stock[0])),
        "masked, fused Adam": make("SparsePolicy", dict(SPARSE)),
        "masked, SB3's Adam": make("SparsePolicy", dict(SPARSE, optimizer_kwargs=eager)),
    }
    times = interleaved({variant: train for variant, (_, train, _) in variants.items()}, rounds)
    steps = stock[2]
    base = times["dense, stock"]
    return {
        variant: (
            1e3 * median(values) / steps,
            median(value / reference for value, reference in zip(values, base, strict=True)),
        )
        for variant, values in times.items()
    }


def time_topology_update(width: int, interval: int) -> tuple[float, float]:
    """Time one RigL update of a width x width layer, and ``interval`` gradient steps."""
    env = RandomEnv(VECTOR, spaces.Discrete(4))
    make = off_policy(DQN, env, 256, 3, net_arch=[width, width])
    model, train, steps = make("SparsePolicy", dict(SPARSE))
    train()
    start = time.perf_counter()
    train()
    step = (time.perf_counter() - start) / steps
    plans = SparsityCallback("rigl", update_interval=1, drop_fraction=0.5).plans
    sparse = model.policy.sparse
    moving = []
    for _ in range(3):
        sparse.start(plans, soft_targets=False, in_force=lambda: True)
        updates = sparse.networks[0].mask_updates
        start = time.perf_counter()
        train()
        moving.append((time.perf_counter() - start) / steps - step)
        sparse.stop()
        assert sparse.networks[0].mask_updates == updates + steps
    return median(moving), interval * step


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=21, help="rounds of each case (default 21)")
    parser.add_argument("--cases", default="", help="only the cases that contain this text")
    parser.add_argument("--skip-update", action="store_true", help="leave out the 4096-wide update")
    args = parser.parse_args()
    th.set_num_threads(1)
    print(f"torch {th.__version__}, 1 thread, {SPARSITY:.0%} ERK, median of {args.rounds} rounds\n")
    print("| case | variant | ms a step | ratio to stock | ratio to dense fused | target |")
    print("|---|---|---|---|---|---|")
    for name in [name for name in CASES if args.cases in name]:
        results = time_case(name, args.rounds)
        fused = results["dense, fused Adam"][1]
        for variant, (milliseconds, ratio) in results.items():
            target = f"≤ {CASES[name][2]}" if variant == "masked, fused Adam" else ""
            print(
                f"| {name} | {variant} | {milliseconds:.2f} | {ratio:.3f} | {ratio / fused:.3f} "
                f"| {target} |",
                flush=True,
            )
    if not args.skip_update:
        update, steps = time_topology_update(4096, 1000)
        print(
            f"\nRigL update, DQN 4096x4096: {update:.2f} s; 1000 gradient steps (batch 256): "
            f"{steps:.0f} s; share {update / (update + steps):.2%} (target < 1 %)"
        )


if __name__ == "__main__":
    main()
