"""Plays episodes that can be paired: equal numbers mean equal seeds."""

from __future__ import annotations

import math

import numpy as np
import torch as th
from stable_baselines3.common.atari_wrappers import EpisodicLifeEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_sparse.errors import ConfigError


def check_eval_env(env: VecEnv) -> None:
    """Reject environments whose returns would not be the model's.

    :raises ConfigError: if their normalisation learns or scales rewards, or if there are several
        and a reset would not start a new game
    """
    normalize = unwrap_vec_normalize(env)
    if normalize is not None and (normalize.training or normalize.norm_reward):
        raise ConfigError(
            "the evaluation environment normalises rewards or learns its statistics; set "
            "eval_env.training = False and eval_env.norm_reward = False"
        )
    if env.num_envs > 1 and any(env.env_is_wrapped(EpisodicLifeEnv)):
        raise ConfigError(
            f"{env.num_envs} evaluation environments end an episode with each life and cannot be "
            "reset in the middle of a game; give one environment, or terminal_on_life_loss=False"
        )


def episode_returns(
    model: PolicyPredictor, env: VecEnv, episodes: int, seed: int, deterministic: bool
) -> list[float]:
    """Play episodes and return their undiscounted returns.

    Each environment plays equally many, so that short episodes are not favoured. As in SB3, a
    Monitor's returns count if there is one. The state of torch's generator does not change.

    :param model: a model, or anything else that predicts actions as one does
    :param episodes: number of episodes, rounded up to a multiple of the number of environments
    :param seed: seed of the environments and of sampled actions
    :param deterministic: whether the policy acts deterministically
    """
    rounds = math.ceil(episodes / env.num_envs)
    monitored = all(env.env_is_wrapped(Monitor))
    returns = np.zeros((rounds, env.num_envs))
    played = np.zeros(env.num_envs, dtype=np.int64)
    running = np.zeros(env.num_envs)
    device = getattr(model, "device", th.device("cpu"))
    devices = [device] if device.type == "cuda" else []
    with th.random.fork_rng(devices=devices):
        th.manual_seed(seed)
        env.seed(seed)
        observation = env.reset()
        while (played < rounds).any():
            actions, _ = model.predict(observation, deterministic=deterministic)  # type: ignore[arg-type]
            observation, rewards, dones, infos = env.step(actions)
            running += rewards
            for index in np.flatnonzero(dones):
                episode = infos[index].get("episode") if monitored else None
                if monitored and episode is None:
                    continue  # a life was lost, but the game continues
                if played[index] < rounds:
                    total = running[index] if episode is None else episode["r"]
                    returns[played[index], index] = total
                played[index] += 1
                running[index] = 0.0
    found: list[float] = returns.ravel().tolist()
    return found
