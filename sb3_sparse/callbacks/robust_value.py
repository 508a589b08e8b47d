"""The callback of RLx2's robust value learning: multi-step returns and a dynamic replay buffer."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_sparse.buffers import DynamicReplayBuffer
from sb3_sparse.callbacks.interval import IntervalCallback, check_whole
from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.internals import planned_timesteps
from sb3_sparse.sparsity.numeric import is_number


class RobustValueCallback(IntervalCallback):
    """Learns from returns over several steps, and forgets experience of policies long gone.

    Beside ``SparsityCallback("rigl")`` this is RLx2. It is for SAC, TD3, DDPG, TQC and CrossQ,
    whether their networks are sparse or not.

    - From ``multi_step_begin`` on, targets are returns over ``multi_step`` steps.
    - Every ``check_interval`` gradient steps, the action means that were stored with the ``oldest``
      transitions are compared with those of the present policy. Their distance is the mean of
      ``(stored - present)² / 2`` over transitions and actions, which are in units of their bound.
      While it exceeds ``distance_threshold``, the compared transitions are forgotten and the next
      ones compared, but ``min_buffer_size`` transitions stay. A comparison that is due after the
      last gradient step of a training takes place when it ends.

    The action mean is what ``predict(deterministic=True)`` returns, and costs one such call an
    environment step. Transitions that SB3 collects at random before ``learning_starts`` get the
    random action itself, as in the published code. A model with SB3's own replay buffer gets a
    :class:`~sb3_sparse.buffers.DynamicReplayBuffer` with the same content, of the same capacity.
    No random number is drawn, and with ``multi_step=1`` and an infinite threshold the training is
    the same as without the callback.

    To resume a training, load the model and its replay buffer, and pass the same callback again.

    Logged: ``robust_value/n_steps``, ``robust_value/buffer_size`` (transitions) and
    ``robust_value/distance`` (of the oldest transitions at the last comparison, before any of them
    were forgotten).

    Example::

        from sb3_sparse import SAC, RobustValueCallback, SparsityCallback

        kwargs = dict(sparsity=0.9, net_arch=[32, 32])
        model = SAC("SparsePolicy", "Pendulum-v1", learning_starts=10, policy_kwargs=kwargs)
        rlx2 = [
            SparsityCallback("rigl", update_interval=20),
            RobustValueCallback(check_interval=20, min_buffer_size=30, oldest=10),
        ]
        model.learn(60, callback=rlx2)
        model.replay_buffer.n_steps  # 3

    :param multi_step: steps of the returns, 1 or more
    :param multi_step_begin: progress (environment steps done / planned) at which they begin;
        before, returns are over one step
    :param check_interval: gradient steps between two comparisons
    :param distance_threshold: distance above which transitions are forgotten; ``inf``: never
    :param min_buffer_size: transitions that are always kept
    :param oldest: transitions that are compared and forgotten at a time
    :param verbose: as in SB3
    :raises ConfigError: for a value that is not allowed; when training begins, for an algorithm
        without continuous actions or a replay buffer of another kind

    Source: arXiv:2205.15043, section 4.2.
    """

    def __init__(
        self,
        *,
        multi_step: int = 3,
        multi_step_begin: float = 0.1,
        check_interval: int = 10_000,
        distance_threshold: float = 0.2,
        min_buffer_size: int = 200_000,
        oldest: int = 2048,
        verbose: int = 0,
    ) -> None:
        check_whole(
            multi_step=multi_step,
            check_interval=check_interval,
            min_buffer_size=min_buffer_size,
            oldest=oldest,
        )
        super().__init__(check_interval, verbose)
        if not is_number(multi_step_begin) or not 0 <= multi_step_begin <= 1:
            raise ConfigError(
                "multi_step_begin is a fraction of training and must lie in [0, 1], got "
                f"{multi_step_begin!r}"
            )
        if not is_number(distance_threshold) or not distance_threshold >= 0:
            raise ConfigError(
                f"distance_threshold must be a number, 0 or more, got {distance_threshold!r}"
            )
        self.multi_step = multi_step
        self.multi_step_begin = multi_step_begin
        self.distance_threshold = distance_threshold
        self.min_buffer_size = min_buffer_size
        self.oldest = oldest

    @property
    def buffer(self) -> DynamicReplayBuffer:
        """The model's replay buffer."""
        buffer = self.model.replay_buffer
        assert isinstance(buffer, DynamicReplayBuffer)
        return buffer

    def _init_callback(self) -> None:
        model: Any = self.model
        actions = model.action_space
        if not isinstance(model, OffPolicyAlgorithm) or not isinstance(actions, spaces.Box):
            raise ConfigError(
                f"RobustValueCallback needs SAC, TD3, DDPG, TQC or CrossQ, got "
                f"{type(model).__name__} with {type(actions).__name__} actions"
            )
        if not isinstance(model.replay_buffer, DynamicReplayBuffer):
            try:
                model.replay_buffer = DynamicReplayBuffer.from_buffer(model.replay_buffer)
            except ConfigError as error:
                raise ConfigError(
                    f"{error}; for RobustValueCallback leave out n_steps (it has multi_step), "
                    "replay_buffer_class and optimize_memory_usage"
                ) from error
            model.replay_buffer_class = DynamicReplayBuffer

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._store_means(None)

    def _on_rollout_end(self) -> None:
        self._store_means(self.model.num_timesteps)
        planned = planned_timesteps(self.model)
        progress = self.model.num_timesteps / planned if planned else 1.0
        buffer = self.buffer
        buffer.n_steps = self.multi_step if progress >= self.multi_step_begin else 1
        buffer.gamma = self.model.gamma
        self.logger.record("robust_value/n_steps", buffer.n_steps)
        self.logger.record("robust_value/buffer_size", buffer.size() * buffer.n_envs)

    def _on_training_end(self) -> None:
        # Of a rollout that a callback stopped, the last step was taken but not stored.
        self._store_means(self.model.num_timesteps - self.model.n_envs)
        super()._on_training_end()

    def _store_means(self, timesteps: int | None) -> None:
        """Store the action means of the rows that have none yet.

        :param timesteps: environment steps up to the newest row; None: not known, as for rows that
            were collected without the callback
        """
        buffer, model = self.buffer, self.model
        count = buffer.without_means
        if not count:
            return
        rows = buffer.newest(count)
        means = self._means(rows)
        if timesteps is not None and not (model.use_sde and model.use_sde_at_warmup):
            before = timesteps - buffer.n_envs * np.arange(count, 0, -1)
            random = before < model.learning_starts
            means[random] = buffer.actions[rows[random]]
        buffer.store_means(means)

    def _means(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Compute the present action means, shape ``(rows, environments, dim)``.

        In parts of ``oldest`` transitions at most, since rows may be those of a whole buffer.
        """
        size = self._rows(self.oldest)
        parts = [self._means_of(rows[at : at + size]) for at in range(0, len(rows), size)]
        return np.concatenate(parts)

    def _rows(self, transitions: int) -> int:
        """Return the rows that hold as many transitions, rounded up."""
        return -(-transitions // self.buffer.n_envs)

    def _means_of(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        observations: Any = self.buffer.observations[rows]
        observations = observations.reshape(-1, *(self.model.observation_space.shape or ()))
        normalization = self.model.get_vec_normalize_env()
        if normalization is not None:
            observations = normalization.normalize_obs(observations)
        policy = self.model.policy
        actions, _ = policy.predict(observations, deterministic=True)
        scaled: NDArray[np.float32] = policy.scale_action(actions)
        return scaled.reshape(len(rows), self.buffer.n_envs, self.buffer.action_dim)

    def act(self, step: int) -> None:
        """Forget the oldest transitions while the policies part, and log their distance."""
        buffer = self.buffer
        block, least = self._rows(self.oldest), self._rows(self.min_buffer_size)
        if not buffer.size():
            return
        first = distance = self._distance(block)
        while distance > self.distance_threshold and buffer.size() > least:
            buffer.shrink(min(block, buffer.size() - least))
            distance = self._distance(block)
        self.logger.record("robust_value/distance", first)

    def _distance(self, count: int) -> float:
        """Compute the distance of the oldest rows."""
        rows = self.buffer.oldest(min(count, self.buffer.size()))
        parted = self.buffer.action_means[rows].astype(np.float64) - self._means(rows)
        return float(np.mean(parted**2)) / 2
