"""Reports episodes that a wrapper ends."""

from __future__ import annotations

import time
from typing import Any, SupportsFloat

import gymnasium as gym
from stable_baselines3.common.env_util import unwrap_wrapper
from stable_baselines3.common.monitor import Monitor


class CutEpisodes(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Reports episodes that a wrapper ends outside of SB3's Monitor, as Monitor reports its own.

    Monitor stands inside of all wrappers that rl-zoo's ``env_wrapper`` names, so it does not see an
    end that one of these decides, such as a ``TimeLimit``. SB3's ``evaluate_policy`` counts only
    ends that Monitor has reported, and would wait for ever. Where Monitor has reported an end, or
    where the game goes on after the loss of a life, nothing changes.

    It must be the outermost wrapper of an environment of an SB3 VecEnv, which resets an environment
    before it hands out the ``info`` of an episode's last step.

    Example::

        import gymnasium as gym
        from gymnasium.wrappers import TimeLimit
        from sb3_sparse.wrappers import CutEpisodes
        from stable_baselines3.common.env_util import make_vec_env
        from stable_baselines3.common.monitor import Monitor

        def wrapped(env: gym.Env) -> gym.Env:
            return CutEpisodes(TimeLimit(env, 50))

        envs = make_vec_env("Pendulum-v1", wrapper_class=wrapped)  # episodes of 50 steps, not 200

    :param env: environment with a Monitor among its wrappers; without one, nothing changes
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)
        monitor = unwrap_wrapper(env, Monitor)
        assert monitor is None or isinstance(monitor, Monitor)
        self.monitor = monitor
        self._last: dict[str, Any] | None = None  # of a step that ended an episode unreported

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """As in Gymnasium."""
        observation, reward, terminated, truncated, info = super().step(action)
        over = (terminated or truncated) and "episode" not in info
        self._last = info if over else None
        return observation, reward, terminated, truncated, info

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """As in Gymnasium; completes the ``info`` of the last step."""
        last, self._last = self._last, None
        monitor = self.monitor
        if last is None or monitor is None:
            return super().reset(seed=seed, options=options)
        rewards, reported = monitor.rewards, len(monitor.episode_returns)
        start = super().reset(seed=seed, options=options)
        begun = monitor.rewards is not rewards  # Monitor was reset, too
        if begun and len(monitor.episode_returns) == reported:
            last["episode"] = _report(monitor, rewards, last)
        return start


def _report(monitor: Monitor[Any, Any], rewards: list[float], info: dict[str, Any]) -> Any:
    """Let Monitor record an episode, and return what it says of one."""
    seconds = time.time() - monitor.t_start
    monitor.episode_returns.append(sum(rewards))
    monitor.episode_lengths.append(len(rewards))
    monitor.episode_times.append(seconds)
    episode = {
        "r": round(sum(rewards), 6),
        "l": len(rewards),
        "t": round(seconds, 6),
        **{key: info[key] for key in monitor.info_keywords},
    }
    if monitor.results_writer is not None:
        monitor.results_writer.write_row(episode)
    return episode
