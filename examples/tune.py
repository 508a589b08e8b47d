"""Search weight decay and update interval of DQN with RigL, first in one call, then step by step.

python examples/tune.py --steps 30000 --trials 12 --workers 2
"""

from __future__ import annotations

import argparse
from pathlib import Path

import optuna

from sb3_sparse.tuning import Objective, Space, open_storage, tune, write_report
from sb3_sparse.zoo import RunSpec

choices = optuna.distributions.CategoricalDistribution


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=30_000)
    parser.add_argument("--trials", type=int, default=12)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--logs", type=Path, default=Path("logs"))
    args = parser.parse_args()

    run = RunSpec("dqn", "CartPole-v1", method="rigl", sparsity=0.9, n_timesteps=args.steps)
    space = Space(
        "example",
        {
            "weight_decay": choices([0.0, 1e-6, 1e-4]),
            "update_interval": choices([100, 250, 500, 1000]),
        },
    )

    # In one call: a grid, each cell once, trained by processes that share a journal in logs/tune.
    tuned = tune(run, space, trials=args.trials, workers=args.workers, log_folder=args.logs)
    assert tuned.best is not None, tuned.errors
    print(f"grid: return {tuned.best.value:.1f} with {tuned.best.params}, saved in {tuned.config}")
    storage = open_storage(args.logs / "tune" / "journal.log")
    print(f"page: {write_report([tuned.study], storage, tuned.folder / 'report.html')}")

    # Step by step: an objective for an Optuna study of your own, with a sampler of your choice.
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=0), direction="maximize")
    study.optimize(Objective(run, space, seeds=1, folder=args.logs / "own"), n_trials=2)
    print(f"own study: return {study.best_value:.1f} with {study.best_params}")


if __name__ == "__main__":
    main()
