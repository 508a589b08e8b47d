"""Does every method learn? Real training on small tasks, one CSV row a seed.

Two returns are kept, each the mean of 50 episodes of the deterministic policy: of the last policy,
and of the best checkpoint of the last fifth of training, chosen by 10 other episodes each (as the
RL zoo's EvalCallback chooses, but only where masks stand still and pruning is done).

A run that is in the CSV already is not run again, so an interrupted benchmark continues.

    python benchmarks/learning.py --workers 2                  # about 50 minutes on two cores
    python benchmarks/learning.py --table                      # the table of what is there
    python benchmarks/learning.py --half-cheetah --workers 2   # the two 100,000-step curves
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: one thread a worker

import argparse
import csv
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from tempfile import TemporaryDirectory

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_sparse.zoo.checkpoint import BestCheckpoint
from sb3_sparse.zoo.train import Run, evaluate, make_env, make_model, reached_sparsity

RESULTS = Path(__file__).parent.parent / "docs" / "results"
TASKS = {"ppo": "CartPole-v1", "dqn": "CartPole-v1", "sac": "Pendulum-v1"}
STEPS = {"sac": 10_000}  # half of the RL zoo's 20,000, to keep the benchmark within the hour
METHODS = ("dense", "static", "set", "rigl", "prune")
BARS = {"CartPole-v1": 450.0, "Pendulum-v1": -250.0}
FIELDS = ("algo", "env", "method", "seed", "sparsity", "steps", "last", "best", "seconds")
EPISODES = 50


def one_run(algo: str, method: str, seed: int) -> dict[str, object]:
    """Train and evaluate; the CSV row."""
    th.set_num_threads(1)
    run = Run(algo, TASKS[algo], method, seed=seed, n_timesteps=STEPS.get(algo))
    env = make_env(run)
    model, callbacks = make_model(run, env)
    with TemporaryDirectory() as folder:
        eval_env = make_vec_env(run.env_id, n_envs=1, seed=seed + 20_000)
        best = BestCheckpoint(eval_env, Path(folder))
        start = time.perf_counter()
        model.learn(run.steps, callback=[*callbacks, best])
        seconds = time.perf_counter() - start
        last_return, _ = evaluate(model, run, EPISODES)
        best_return, _ = evaluate(type(model).load(best.path), run, EPISODES)
    env.close()
    values = (
        algo, run.env_id, method, seed, f"{reached_sparsity(model) or 0.0:.4f}", run.steps,
        f"{last_return:.1f}", f"{best_return:.1f}", f"{seconds:.0f}",
    )  # fmt: skip
    return dict(zip(FIELDS, values, strict=True))


def curve(method: str, steps: int, seed: int) -> None:
    """SAC on HalfCheetah; evaluation every 5,000 steps, appended as it comes."""
    th.set_num_threads(1)
    run = Run(algo="sac", env_id="HalfCheetah-v5", method=method, seed=seed, n_timesteps=steps)
    path = RESULTS / "half_cheetah.csv"
    env = make_env(run)
    eval_env = make_vec_env(run.env_id, n_envs=1, seed=seed + 10_000)

    class Append(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps % 5000 == 0:
                score, _ = evaluate_policy(self.model, eval_env, n_eval_episodes=5)
                with path.open("a", newline="") as file:
                    seconds = time.perf_counter() - start
                    row = (method, seed, self.num_timesteps, f"{score:.1f}", f"{seconds:.0f}")
                    csv.writer(file).writerow(row)
            return True

    model, callbacks = make_model(run, env)
    start = time.perf_counter()
    model.learn(steps, callback=[*callbacks, Append()])


def table(path: Path) -> str:
    """A Markdown table of the CSV."""
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
