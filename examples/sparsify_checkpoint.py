"""A dense checkpoint of stock SB3 made sparse: its largest weights kept, then fine-tuned.

``sb3-sparse compress dense.zip --env CartPole-v1`` searches for the sparsity as well.

python examples/sparsify_checkpoint.py
"""

import argparse
import tempfile
from pathlib import Path

from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_sparse import PPO, sparsify


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=50_000, help="of each of the two trainings")
    args = parser.parse_args()
    env = make_vec_env("CartPole-v1", n_envs=8, seed=0)
    evaluation = make_vec_env("CartPole-v1", seed=1)
    settings = dict(n_steps=32, batch_size=256, n_epochs=20, gamma=0.98, gae_lambda=0.8, seed=0)

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "dense.zip"
        PPO("MlpPolicy", env, learning_rate=1e-3, **settings).learn(args.steps).save(path)
        dense = PPO.load(path, env=env)

    sparse = sparsify(dense, {"actor": 0.95, "critic": 0.0})  # the critic is not deployed
    before, _ = evaluate_policy(dense, evaluation, n_eval_episodes=20)
    pruned, _ = evaluate_policy(sparse, evaluation, n_eval_episodes=20)
    sparse.learn(args.steps, reset_num_timesteps=False)

    print(sparse.policy.sparsity_report())
    after, _ = evaluate_policy(sparse, evaluation, n_eval_episodes=20)
    print(f"return {before:.0f} dense, {pruned:.0f} pruned, {after:.0f} fine-tuned")


if __name__ == "__main__":
    main()
