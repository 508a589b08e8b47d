"""A dense checkpoint of stock SB3 made sparse: its weights, pruned and fine-tuned.

python examples/sparsify_checkpoint.py
"""

import argparse
import tempfile
from pathlib import Path

from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_sparse import SparsePolicy, SparsityCallback


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=50_000, help="of each of the two trainings")
    args = parser.parse_args()
    env = make_vec_env("CartPole-v1", n_envs=8, seed=0)
    settings = dict(n_steps=32, batch_size=256, n_epochs=20, gamma=0.98, gae_lambda=0.8, seed=0)

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "dense.zip"
        dense = PPO("MlpPolicy", env, **settings)
        dense.learn(args.steps)
        dense.save(path)
        before, _ = evaluate_policy(dense, env, n_eval_episodes=20)

        sparse = PPO(
            SparsePolicy, env, policy_kwargs=dict(sparsity=0.8, initial_sparsity=0.0), **settings
        )
        # The dense file has no masks, so it cannot match exactly; its weights and moments do.
        sparse.set_parameters(path, exact_match=False)

    sparse.learn(args.steps, callback=SparsityCallback("prune", update_interval=100, begin=0.0))

    print(sparse.policy.sparsity_report())
    after, _ = evaluate_policy(sparse, env, n_eval_episodes=20)
    print(f"return {before:.0f} dense, {after:.0f} sparse")


if __name__ == "__main__":
    main()
