"""PPO with SET by the shipped config, another sparsity, noisy sensors; then the dense baseline.

python examples/run_from_config.py
"""

import argparse
from pathlib import Path

from sb3_sparse.zoo import RunSpec, train


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=100_000)
    args = parser.parse_args()

    noise = [{"sb3_sparse.wrappers.ObservationNoise": {"sigma": 0.1}}]
    common = dict(
        algo="ppo",
        env_id="CartPole-v1",
        n_timesteps=args.steps,
        eval_freq=max(1, args.steps // 10),
        seed=1,
        hyperparams={"env_wrapper": noise},
    )
    for run in (
        RunSpec(method="set", sparsity=0.8, **common),
        RunSpec(method="dense", match_params=0.8, **common),
    ):
        outcome = train(run, Path("logs"))
        print(outcome.model.policy.sparsity_report())
        for result in outcome.results:
            print(f"{result.what}: return {result.mean_return:.1f} ± {result.std_return:.1f}")
        print(f"settings, counts and versions: {outcome.folder / 'sparsity.json'}\n")


if __name__ == "__main__":
    main()
