"""A wrapper that repeats actions."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from sb3_sparse.errors import ConfigError
from sb3_sparse.sparsity.numeric import is_whole


class ActionRepeat(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Takes each action several times, and returns the sum of the rewards.

    A step of the wrapped environment is a decision: with ``repeat=2``, an episode of 1000 steps has
    500 decisions, and SB3 and rl-zoo count decisions (``n_timesteps``, ``learning_starts``,
    ``eval_freq``). Lengths of episodes (``ep_len_mean``, ``monitor.csv``) count steps of the
    wrapped environment, since rl-zoo puts its monitor around that one. An episode that ends between
    two repetitions ends there.

    Example::

        import gymnasium as gym
        from sb3_sparse.wrappers import ActionRepeat

        env = ActionRepeat(gym.make("Pendulum-v1"), repeat=2)  # 100 decisions an episode

    :param env: environment
    :param repeat: how many times each action is taken, 1 or more
    :raises ConfigError: for another ``repeat``
    """

    def __init__(self, env: gym.Env[Any, Any], repeat: int) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, repeat=repeat)
        super().__init__(env)
        if not is_whole(repeat) or repeat < 1:
            raise ConfigError(f"repeat must be a whole number, 1 or more, got {repeat!r}")
        self.repeat = int(repeat)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take the action ``repeat`` times, or until the episode ends.

        :return: the last observation, the sum of the rewards, and how the last repetition ended
        """
        total = 0.0
        for _ in range(self.repeat):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += float(reward)
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, info
