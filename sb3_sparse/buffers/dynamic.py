"""The replay buffer that stores action means and can forget its oldest part."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sparse.errors import ConfigError
from sb3_sparse.sparsity.numeric import is_whole

Rows = NDArray[np.int64]


class DynamicReplayBuffer(NStepReplayBuffer):
    """SB3's n-step replay buffer that also stores the policy's action means, and can shrink.

    A row holds one transition of each environment. ``shrink`` forgets the oldest rows: they are
    never sampled again, and new ones take their place until the buffer is full again. Returns over
    one step (``n_steps=1``) are those of SB3's ``ReplayBuffer``, drawn by the same random numbers.

    :class:`~sb3_sparse.callbacks.RobustValueCallback` does all this during training.

    Example::

        import numpy as np
        from sb3_sparse import SAC
        from sb3_sparse.buffers import DynamicReplayBuffer

        kwargs = dict(sparsity=0.9, net_arch=[32])
        model = SAC(
            "SparsePolicy",
            "Pendulum-v1",
            replay_buffer_class=DynamicReplayBuffer,
            policy_kwargs=kwargs,
        )
        model.learn(20)
        buffer = model.replay_buffer
        buffer.store_means(np.zeros((20, 1, 1)))  # of the 20 rows, which have none so far
        buffer.shrink(5)
        buffer.size()  # 15

    :param args: as in SB3
    :param n_steps: steps of the returns, 1 or more; it may be changed at any time
    :param gamma: discount factor of returns over several steps
    :param kwargs: as in SB3
    :raises NotImplementedError: for ``optimize_memory_usage``, as in SB3

    Source: arXiv:2205.15043, section 4.2.
    """

    action_means: NDArray[np.float32]
    """Action means, in units of the bound, shape ``(rows, environments, dim)``."""
    forgotten: int
    """Rows that ``shrink`` has forgotten and nothing has overwritten since; the oldest."""
    without_means: int
    """Rows whose action means have not been stored yet; the newest."""

    def __init__(self, *args: Any, n_steps: int = 1, gamma: float = 0.99, **kwargs: Any) -> None:
        super().__init__(*args, n_steps=n_steps, gamma=gamma, **kwargs)
        self._begin(stored=0)

    @classmethod
    def from_buffer(cls, buffer: ReplayBuffer | None) -> DynamicReplayBuffer:
        """Make one of SB3's replay buffer. It takes the arrays over: discard the other.

        :param buffer: SB3's ``ReplayBuffer``, of which no subclass will do
        :raises ConfigError: for another class, or with ``optimize_memory_usage``
        """
        if type(buffer) is not ReplayBuffer or buffer.optimize_memory_usage:
            memory = " with it" if getattr(buffer, "optimize_memory_usage", False) else ""
            raise ConfigError(
                "a DynamicReplayBuffer can be made of SB3's ReplayBuffer without "
                f"optimize_memory_usage, got {type(buffer).__name__}{memory}"
            )
        made = cls.__new__(cls)
        vars(made).update(vars(buffer), n_steps=1, gamma=0.99)
        made._begin(stored=buffer.size())
        return made

    def _begin(self, stored: int) -> None:
        shape = (self.buffer_size, self.n_envs, self.action_dim)
        self.action_means = np.zeros(shape, dtype=np.float32)
        self.forgotten = 0
        self.without_means = stored

    def size(self) -> int:
        """Rows in use."""
        return super().size() - self.forgotten

    def reset(self) -> None:
        """As in SB3."""
        super().reset()
        self.forgotten = self.without_means = 0

    @property
    def _first(self) -> int:
        """The oldest row in use, counted on past the end of the ring."""
        return (self.pos if self.full else 0) + self.forgotten

    def oldest(self, count: int) -> Rows:
        """Return the numbers of the oldest rows in use, from the oldest.

        :param count: how many, at most :meth:`size`
        """
        return (self._first + np.arange(count)) % self.buffer_size

    def newest(self, count: int) -> Rows:
        """Return the numbers of the newest rows in use, up to the newest.

        :param count: how many, at most :meth:`size`
        """
        return (self.pos - count + np.arange(count)) % self.buffer_size

    def add(self, *args: Any, **kwargs: Any) -> None:
        """As in SB3."""
        overwrites = self.full
        super().add(*args, **kwargs)
        if overwrites and self.forgotten:
            self.forgotten -= 1
        self.without_means = min(self.without_means + 1, self.size())

    def store_means(self, means: NDArray[Any]) -> None:
        """Store the action means of the rows that have none yet.

        :param means: in units of the bound, shape ``(without_means, environments, dim)``
        :raises ConfigError: for another shape
        """
        rows = self.newest(self.without_means)
        wanted = self.action_means[rows].shape
        if np.shape(means) != wanted:
            raise ConfigError(
                f"the rows without action means take an array of shape {wanted}, got "
                f"{np.shape(means)}"
            )
        self.action_means[rows] = means
        self.without_means = 0

    def shrink(self, rows: int) -> None:
        """Forget the oldest rows.

        :param rows: how many, fewer than :meth:`size`
        :raises ConfigError: for another number
        """
        if not is_whole(rows) or not 0 <= rows < max(self.size(), 1):
            raise ConfigError(
                f"of {self.size()} rows a buffer can forget any number but all, got {rows!r}"
            )
        self.forgotten += rows
        self.without_means = min(self.without_means, self.size())

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """As in SB3, of the rows in use."""
        if not self.forgotten:
            return super().sample(batch_size, env)
        drawn = np.random.randint(0, self.size(), size=batch_size)
        return self._get_samples((self._first + drawn) % self.buffer_size, env)

    def _get_samples(
        self, batch_inds: Rows, env: VecNormalize | None = None
    ) -> ReplayBufferSamples:
        if self.n_steps == 1:  # without discounts: the algorithm has its own
            return ReplayBuffer._get_samples(self, batch_inds, env)
        return super()._get_samples(batch_inds, env)
