"""Does every method learn? Training on small tasks, with one CSV row per seed.

Settings are the RL zoo's tuned ones (zoo_hparams/ has those of the paper), with the paper's mask
settings; dense is SB3's own policy.

Two returns are recorded, each the mean of 50 episodes of the deterministic policy: that of the last
policy, and that of the best checkpoint of the last fifth of training, chosen by 10 other episodes
(as the RL zoo's EvalCallback does, but only after masks have stopped moving).

Runs that are already in the CSV are skipped, so an interrupted benchmark continues.

    python benchmarks/learning.py --workers 2                  # about 50 minutes on two cores
    python benchmarks/learning.py --table                      # the table of what is there
    python benchmarks/learning.py --half-cheetah --workers 2   # the two 100,000-step curves
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: one thread a worker

import argparse
import csv
import math
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch as th
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import LinearSchedule

from sb3_sparse import SparsityCallback

RESULTS = Path(__file__).parent.parent / "docs" / "results"
TASKS = {"ppo": "CartPole-v1", "dqn": "CartPole-v1", "sac": "Pendulum-v1"}
ALGORITHMS: dict[str, Any] = {"ppo": PPO, "dqn": DQN, "sac": SAC}
SPARSITY = 0.9
# SAC: half of the RL zoo's 20,000, to keep the benchmark within the hour
STEPS = {"ppo": 100_000, "dqn": 50_000, "sac": 10_000}
ENVS = {"ppo": 8, "dqn": 1, "sac": 1}
# Source: rl-baselines3-zoo 2.9, hyperparams/.
TUNED: dict[str, dict[str, Any]] = {
    "ppo": dict(
        n_steps=32,
        batch_size=256,
        gae_lambda=0.8,
        gamma=0.98,
        n_epochs=20,
        ent_coef=0.0,
        learning_rate=LinearSchedule(0.001, 0.0, 1.0),
        clip_range=LinearSchedule(0.2, 0.0, 1.0),
    ),
    "dqn": dict(
        learning_rate=2.3e-3,
        batch_size=64,
        buffer_size=100_000,
        learning_starts=1000,
        gamma=0.99,
        target_update_interval=10,
        train_freq=256,
        gradient_steps=128,
        exploration_fraction=0.16,
        exploration_final_eps=0.04,
    ),
    "sac": dict(learning_rate=1e-3),
}
NET_ARCH = {"dqn": [256, 256]}
INTERVAL = {"ppo": 250}  # else 1000
DROP_FRACTION = {"ppo": 0.3}  # else 0.5
METHODS = ("dense", "static", "set", "rigl", "prune")
BARS = {"CartPole-v1": 450.0, "Pendulum-v1": -250.0}
FIELDS = ("algo", "env", "method", "seed", "sparsity", "steps", "last", "best", "seconds")
EPISODES = 50


class BestCheckpoint(EvalCallback):
    """Keeps the best of ten checkpoints in the last fifth of training."""

    def __init__(self, eval_env, folder: str) -> None:
        super().__init__(eval_env, n_eval_episodes=10, best_model_save_path=folder, verbose=0)

    def _on_training_start(self) -> None:
        self.planned = self.model._total_timesteps
        self.eval_freq = math.ceil(0.02 * self.planned / self.model.n_envs)

    def _on_step(self) -> bool:
        policy = self.model.policy
        denser = hasattr(policy, "sparse") and any(n.denser for n in policy.sparse.networks)
        if not 0.8 * self.planned < self.num_timesteps <= self.planned or denser:
            return True
        return super()._on_step()


def make(algo: str, env, method: str, seed: int, **settings) -> tuple[BaseAlgorithm, list]:
    """Make the model and the callback that moves its masks."""
    kwargs = {"net_arch": NET_ARCH[algo]} if algo in NET_ARCH else {}
    callbacks = []
    if method != "dense":
        kwargs["sparsity"] = SPARSITY
        options = {}
        if method != "static":
            options["update_interval"] = INTERVAL.get(algo, 1000)
        if method in ("set", "rigl"):
            options["drop_fraction"] = DROP_FRACTION.get(algo, 0.5)
        if method == "prune":
            kwargs["initial_sparsity"] = 0.0
        callbacks = [SparsityCallback(method, **options)]
    policy = "MlpPolicy" if method == "dense" else "SparsePolicy"
    model = ALGORITHMS[algo](policy, env, seed=seed, policy_kwargs=kwargs, **settings)
    return model, callbacks


def evaluate(model: BaseAlgorithm, env_id: str, seed: int) -> float:
    """Compute the mean return on fresh environments."""
    env = make_vec_env(env_id, n_envs=1, seed=seed + 10_000)
    mean, _ = evaluate_policy(model, env, n_eval_episodes=EPISODES, deterministic=True)
    return mean


def one_run(algo: str, method: str, seed: int) -> dict[str, object]:
    """Train and evaluate; return the CSV row."""
    th.set_num_threads(1)
    env_id, steps = TASKS[algo], STEPS[algo]
    env = make_vec_env(env_id, n_envs=ENVS[algo], seed=seed)
    model, callbacks = make(algo, env, method, seed, **TUNED[algo])
    with TemporaryDirectory() as folder:
        best = BestCheckpoint(make_vec_env(env_id, n_envs=1, seed=seed + 20_000), folder)
        start = time.perf_counter()
        model.learn(steps, callback=[*callbacks, best])
        seconds = time.perf_counter() - start
        last_return = evaluate(model, env_id, seed)
        best_return = evaluate(type(model).load(f"{folder}/best_model"), env_id, seed)
    env.close()
    sparsity = 0.0 if method == "dense" else model.policy.sparse.sparsity
    values = (
        algo, env_id, method, seed, f"{sparsity:.4f}", steps,
        f"{last_return:.1f}", f"{best_return:.1f}", f"{seconds:.0f}",
    )  # fmt: skip
    return dict(zip(FIELDS, values, strict=True))


def curve(method: str, steps: int, seed: int) -> None:
    """Train SAC on HalfCheetah; append an evaluation every 5,000 steps."""
    th.set_num_threads(1)
    env_id = "HalfCheetah-v5"
    path = RESULTS / "half_cheetah.csv"
    env = make_vec_env(env_id, n_envs=1, seed=seed)
    eval_env = make_vec_env(env_id, n_envs=1, seed=seed + 10_000)

    class Append(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps % 5000 == 0:
                score, _ = evaluate_policy(self.model, eval_env, n_eval_episodes=5)
                with path.open("a", newline="") as file:
                    seconds = time.perf_counter() - start
                    row = (method, seed, self.num_timesteps, f"{score:.1f}", f"{seconds:.0f}")
                    csv.writer(file).writerow(row)
            return True

    model, callbacks = make("sac", env, method, seed, learning_starts=10_000)
    start = time.perf_counter()
    model.learn(steps, callback=[*callbacks, Append()])


def table(path: Path) -> str:
    """Format the CSV as a Markdown table."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    lines = [
        "| task | method | last policy, by seed | best checkpoint, by seed | at the bar |",
        "|---|---|---|---|---|",
    ]
    for algo, env in TASKS.items():
        for method in METHODS:
            found = [r for r in rows if (r["algo"], r["method"]) == (algo, method)]
            found.sort(key=lambda row: int(row["seed"]))
            if not found:
                continue
            cells = [
                ", ".join(f"{float(r[key]):.0f}" if r[key] else "–" for r in found)
                for key in ("last", "best")
            ]
            passed = [
                sum(bool(r[key]) and float(r[key]) >= BARS[env] for r in found)
                for key in ("last", "best")
            ]
            counts = (
                f"{passed[0]}"
                if not all(r["best"] for r in found)
                else f"{passed[0]} and {passed[1]}"
            )
            lines.append(
                f"| {algo.upper()}, {env} | {method} | {cells[0]} | {cells[1]} "
                f"| {counts} of {len(found)} ≥ {BARS[env]:.0f} |"
            )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--algos", nargs="*", default=list(TASKS))
    parser.add_argument("--table", action="store_true", help="only print the table")
    parser.add_argument("--half-cheetah", action="store_true", help="the two curves instead")
    parser.add_argument("--steps", type=int, default=100_000, help="steps of the curves")
    args = parser.parse_args()
    RESULTS.mkdir(parents=True, exist_ok=True)
    path = RESULTS / "learning.csv"
    if args.table:
        print(table(path))
        return
    with ProcessPoolExecutor(args.workers) as pool:
        if args.half_cheetah:
            header = "method,seed,steps,mean_return,seconds\n"
            (RESULTS / "half_cheetah.csv").write_text(header)
            futures = [pool.submit(curve, method, args.steps, 1) for method in ("dense", "rigl")]
            for future in as_completed(futures):
                future.result()
            return
        if not path.exists():
            path.write_text(",".join(FIELDS) + "\n")
        with path.open(newline="") as file:
            done = {(r["algo"], r["method"], int(r["seed"])) for r in csv.DictReader(file)}
        cells = [
            (algo, method, seed)
            for algo in args.algos
            for seed in range(1, args.seeds + 1)
            for method in METHODS
        ]
        futures = [pool.submit(one_run, *cell) for cell in cells if cell not in done]
        for future in as_completed(futures):
            row = future.result()
            with path.open("a", newline="") as file:
                csv.DictWriter(file, FIELDS).writerow(row)
            print(row, flush=True)
    print(table(path))


if __name__ == "__main__":
    main()
