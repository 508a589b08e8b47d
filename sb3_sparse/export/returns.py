"""What rounding does to the return."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_sparse.analysis.evaluation import episode_returns
from sb3_sparse.export.observations import count_of, raw_of
from sb3_sparse.export.parity import Actor

EPISODES = 20


@dataclass(frozen=True)
class Returns:
    """Returns of a policy in float32 and of the exported one, in episodes with the same seeds.

    :param float32: of the model itself, by episode
    :param int8: of what was exported, by episode

    Example::

        from sb3_sparse.export import Returns

        print(Returns(float32=(-150.0, -160.0), int8=(-151.0, -160.0)))
    """

    float32: tuple[float, ...]
    int8: tuple[float, ...]

    def __str__(self) -> str:
        means = [f"{np.mean(part):.2f} ± {np.std(part):.2f}" for part in (self.float32, self.int8)]
        return (
            f"{means[0]} by the model, {means[1]} as exported; mean and standard deviation of "
            f"{len(self.int8)} episodes with the same seeds"
        )


def play_both(
    own: Actor,
    exported: Actor,
    env: VecEnv,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
) -> Returns:
    """Let both policies play at least 20 episodes, equally many in each environment.

    :param own: the model
    :param env: environments with the model's wrappers
    :param observation_space: the model's
    :param action_space: the model's
    """
    played = []
    for actor in (own, exported):
        player = _Player(actor, env, observation_space, action_space)
        played.append(tuple(episode_returns(player, env, EPISODES, 0, deterministic=True)))
    return Returns(*played)


@dataclass
class _Player:
    """Predicts as a model does, by a function of raw observations."""

    actor: Actor
    env: VecEnv
    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]

    def predict(
        self,
        observation: Any,
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], None]:
        raw = raw_of(unwrap_vec_normalize(self.env), observation, self.observation_space)
        shape = self.action_space.shape or ()
        actions = self.actor(raw)[:, : int(np.prod(shape))]  # further outputs stand behind
        return actions.reshape((count_of(raw), *shape)).astype(self.action_space.dtype), None
