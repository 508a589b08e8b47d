"""PPO pruned from dense to 90 % sparse while it learns, with the actor kept denser than the critic.

python examples/ppo_pruning.py
"""

import argparse

from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_sparse import PPO, SparsityCallback


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=100_000)
    args = parser.parse_args()

    model = PPO(
        "SparsePolicy",
        make_vec_env("CartPole-v1", n_envs=8, seed=0),
        n_steps=32,
        batch_size=256,
        n_epochs=20,
        gamma=0.98,
        gae_lambda=0.8,
        policy_kwargs=dict(
            sparsity={"actor": 0.85, "critic": 0.95},
            initial_sparsity=0.0,  # pruning starts dense
        ),
        seed=0,
    )
    # From 20 % to 80 % of training, along a cubic ramp.
    model.learn(args.steps, callback=SparsityCallback("prune", update_interval=250))

    print(model.policy.sparsity_report())
    mean, std = evaluate_policy(model, model.get_env(), n_eval_episodes=20)
    print(f"return {mean:.0f} ± {std:.0f}")


if __name__ == "__main__":
    main()
