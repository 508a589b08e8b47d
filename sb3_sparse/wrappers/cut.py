"""Reports episodes that a wrapper ends."""

from __future__ import annotations

import time
from typing import Any, SupportsFloat

import gymnasium as gym
from stable_baselines3.common.env_util import unwrap_wrapper
from stable_baselines3.common.monitor import Monitor


class CutEpisodes(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Reports episodes that are ended by a wrapper outside SB3's Monitor, as Monitor does its own.

    Monitor is inside all wrappers that rl-zoo's ``env_wrapper`` names, so it does not see an end
    that one of these decides, such as a ``TimeLimit``. SB3's ``evaluate_policy`` counts only ends
    that Monitor has reported, and would wait forever. Where Monitor's report arrives, or where the
    game goes on after the loss of a life, nothing changes.

    It must be the outermost wrapper of an environment of an SB3 VecEnv, which resets an environment
    before it hands out the ``info`` of an episode's last step.

    Example::

        import gymnasium as gym
        from gymnasium.wrappers import TimeLimit
        from sb3_sparse.wrappers import CutEpisodes
        from stable_baselines3.common.env_util import make_vec_env

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
        self._last = None
        if (terminated or truncated) and "episode" not in info and self.monitor is not None:
            if self.monitor.needs_reset:  # a wrapper has dropped Monitor's report
                info["episode"] = _latest(self.monitor)
            else:
                self._last = info
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
        seconds, given = time.time() - monitor.t_start, dict(monitor.current_reset_info)
        start = super().reset(seed=seed, options=options)
        begun = monitor.rewards is not rewards  # Monitor was reset, too
        if begun and len(monitor.episode_returns) == reported:
            monitor.episode_returns.append(sum(rewards))
            monitor.episode_lengths.append(len(rewards))
            monitor.episode_times.append(seconds)
            more = {key: last[key] for key in monitor.info_keywords} | given
            last["episode"] = {**_latest(monitor), **more}
            if monitor.results_writer is not None:
                monitor.results_writer.write_row(last["episode"])
        return start


def _latest(monitor: Monitor[Any, Any]) -> dict[str, Any]:
    """What Monitor says of the latest episode that it knows."""
    return {
        "r": round(monitor.episode_returns[-1], 6),
        "l": monitor.episode_lengths[-1],
        "t": round(monitor.episode_times[-1], 6),
    }
