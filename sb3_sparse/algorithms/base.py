"""Base class of all algorithms with fused gradient steps, and what they share."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import preprocess_obs

from sb3_sparse.algorithms.training import Training
from sb3_sparse.errors import UnsupportedError
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.machine import Machine
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.fast_forward import takes_vectors
from sb3_sparse.policies.registry import possible_algorithms, registered


def features(policy: BasePolicy, obs: Any) -> th.Tensor:
    """Convert observations of a buffer to the input of the networks, in a type programs read.

    :param policy: the policy
    :param obs: shape ``(batch, *shape)``
    :raises NotCovered: for dict observations
    """
    if not isinstance(obs, th.Tensor):
        raise NotCovered("dict observations")
    if takes_vectors(policy):
        return obs.flatten(1)
    prepared = preprocess_obs(obs, policy.observation_space, policy.normalize_images)
    assert isinstance(prepared, th.Tensor)
    return prepared.flatten(1)


def mean(numbers: Sequence[float]) -> Any:
    """Average as ``np.mean`` does, but faster for a single number."""
    return np.float64(numbers[0]) if len(numbers) == 1 else np.mean(numbers)


class Fused(BaseAlgorithm):
    """Base class of algorithms whose gradient steps run in one call of the kernels if possible."""

    _training: Training

    def _setup_model(self) -> None:
        self._check_policy_class()
        super()._setup_model()  # type: ignore[safe-super]
        if isinstance(self.policy, BaseSparsePolicy):
            self.policy.use_kernels()  # also at sparsity 0, where the policy would stay SB3's

    def _check_policy_class(self) -> None:
        """Reject a policy of another algorithm, e.g. from a file that it saved.

        :raises UnsupportedError: for a policy class that is known to be of another algorithm
        """
        policy, known = self.policy_class, registered().values()
        if not isinstance(policy, type):
            return  # it raises when it is called: the algorithm has no such policy
        own = [one.stock_policy for one in known if isinstance(self, one.algorithm)]
        others = possible_algorithms(policy)
        if others and not issubclass(policy, tuple(own)):
            name = type(self).__name__
            raise UnsupportedError(
                f"{policy.__name__} is a policy of {' or '.join(others)}, not of {name}; make or "
                f"load the model with {others[0]}"
            )

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_training"]

    def _trains(self) -> Training:
        training = vars(self).get("_training")
        if training is None:
            training = self._training = Training()
        return training

    @abstractmethod
    def _next_machine(self) -> Machine:
        """Return the machine for the next gradient step.

        :raises NotCovered: if programs cannot compute it
        """

    def train(self, *args: Any, **kwargs: Any) -> None:
        """Train as SB3 does, with the arguments of the algorithm's ``train`` there.

        SB3 takes the gradient steps that programs do not cover, such as those of images or gSDE.
        """
        try:
            self._train_fused(*args, **kwargs)
        except NotCovered as why:
            self._not_covered(why)
            super().train(*args, **kwargs)  # type: ignore[misc]

    @abstractmethod
    def _train_fused(self, *args: Any, **kwargs: Any) -> None:
        """Take a round of gradient steps.

        :raises NotCovered: before the first, if programs do not cover them
        """

    def why_not_fused(self) -> str | None:
        """Tell why gradient steps are Stable-Baselines3's own; None: they are fused.

        This records a step of the present model without running it, which takes milliseconds.

        Example::

            from sb3_sparse import SAC

            kwargs = dict(sparsity=0.9)
            model = SAC("SparsePolicy", "Pendulum-v1", policy_kwargs=kwargs, use_sde=True)
            model.why_not_fused()  # 'gSDE'
        """
        try:
            self._next_machine()
        except NotCovered as why:
            return why.reason
        return None

    def _not_covered(self, why: NotCovered) -> None:
        """Log once why gradient steps are SB3's own, if the policy is sparse."""
        training = self._trains()
        training.reason = reason = why.reason
        if reason not in training.logged:
            training.logged.add(reason)
            if isinstance(unwrapped(self.policy), BaseSparsePolicy):
                self.logger.info(f"Gradient steps are Stable-Baselines3's own: {reason}")
