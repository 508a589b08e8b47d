"""A sparse policy as C: exported, compiled, and driving its environment in place of the model.

python examples/deploy_c.py
"""

import argparse
import ctypes
import os
import subprocess
import tempfile
from pathlib import Path

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sparse import PPO, SparsityCallback
from sb3_sparse.export import export_policy, record_observations


def load(source, actions):
    """The C function as a Python one."""
    library = source.with_suffix(".so")
    compiler = os.environ.get("CC", "cc")
    options = ["-std=c99", "-O3", "-shared", "-fPIC"]
    subprocess.run([compiler, *options, str(source), "-o", str(library), "-lm"], check=True)
    function = ctypes.CDLL(str(library)).sb3_sparse_policy
    floats = ctypes.POINTER(ctypes.c_float)
    action = np.empty(actions, np.float32)

    def act(observation):
        row = np.ascontiguousarray(observation, np.float32)
        function(row.ctypes.data_as(floats), action.ctypes.data_as(floats))
        return action.copy()

    return act


def play(env_id, act, episodes):
    """Returns of episodes with seeds 0, 1, ..."""
    env = gym.make(env_id)
    returns = []
    for seed in range(episodes):
        observation, _ = env.reset(seed=seed)
        total, over = 0.0, False
        while not over:
            observation, reward, terminated, truncated, _ = env.step(act(observation))
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    return np.array(returns)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--episodes", type=int, default=10)
    args = parser.parse_args()
    env_id = "Pendulum-v1"
    env = VecNormalize(make_vec_env(env_id, n_envs=4, seed=0), gamma=0.9)
    settings = dict(n_steps=1024, gamma=0.9, gae_lambda=0.95, learning_rate=1e-3, seed=0)
    model = PPO("SparsePolicy", env, policy_kwargs=dict(sparsity=0.8), **settings)
    model.learn(args.steps, callback=SparsityCallback("rigl", update_interval=100))
    print(model.policy.sparsity_report())

    with tempfile.TemporaryDirectory() as folder:
        # The environment's own normalisation goes into the file.
        seen = record_observations(model, env, 1000)
        report = export_policy(model, Path(folder) / "policy", "c", observations=seen)
        print(report)
        act_in_c = load(Path(folder) / "policy.c", env.action_space.shape[0])

        def act_in_python(observation):
            action, _ = model.predict(env.normalize_obs(observation), deterministic=True)
            return action

        python = play(env_id, act_in_python, args.episodes)
        c = play(env_id, act_in_c, args.episodes)
    print(f"return {python.mean():.3f} by model.predict, {c.mean():.3f} by the C file")
    print(f"largest difference of an episode: {np.abs(python - c).max():.2g}")


if __name__ == "__main__":
    main()
