"""SAC with RigL at 90 % on a MuJoCo task.

python examples/sac_rigl_mujoco.py --steps 1000000
"""

import argparse

from stable_baselines3.common.evaluation import evaluate_policy

from sb3_sparse import SAC, SparsityCallback


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--steps", type=int, default=1_000_000)
    args = parser.parse_args()

    model = SAC(
        "SparsePolicy",
        args.env,
        learning_starts=min(10_000, args.steps // 10),
        policy_kwargs=dict(sparsity=0.9, weight_decay=1e-6),
        seed=1,
    )
    rigl = SparsityCallback("rigl", update_interval=1000, drop_fraction=0.5)
    model.learn(args.steps, callback=rigl, progress_bar=True)

    print(model.policy.sparsity_report())
    mean, std = evaluate_policy(model, model.get_env(), n_eval_episodes=5)
    print(f"return {mean:.0f} ± {std:.0f}")


if __name__ == "__main__":
    main()
