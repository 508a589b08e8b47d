"""DQN with SET at 95 %, its output layer dense; saved, loaded and trained on.

python examples/dqn_set.py
"""

import argparse
import tempfile
from pathlib import Path

from stable_baselines3.common.evaluation import evaluate_policy

from sb3_sparse import DQN, SparsityCallback


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=50_000)
    args = parser.parse_args()

    model = DQN(
        "SparsePolicy",
        "CartPole-v1",
        learning_rate=2.3e-3,
        batch_size=64,
        learning_starts=min(1000, args.steps // 10),
        target_update_interval=10,
        train_freq=256,
        gradient_steps=128,
        exploration_fraction=0.16,
        exploration_final_eps=0.04,
        policy_kwargs=dict(net_arch=[256, 256], sparsity=0.95, dense_layers=["output"]),
        seed=0,
    )
    half = args.steps // 2
    model.learn(half, callback=SparsityCallback("set", update_interval=1000, drop_fraction=0.3))

    # The callback holds no state: load the model, pass the same callback again.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "dqn_set"
        model.save(path)
        model = DQN.load(path, env=model.get_env())
    model.learn(
        half,
        callback=SparsityCallback("set", update_interval=1000, drop_fraction=0.3),
        reset_num_timesteps=False,
    )

    print(model.policy.sparsity_report())
    mean, std = evaluate_policy(model, model.get_env(), n_eval_episodes=20)
    print(f"return {mean:.0f} ± {std:.0f}")


if __name__ == "__main__":
    main()
