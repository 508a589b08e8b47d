"""The callback that recycles dormant units: ReDo."""

from __future__ import annotations

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from torch import nn

from sb3_sparse.analysis.activity import activity
from sb3_sparse.analysis.batches import sample_batch
from sb3_sparse.analysis.wiring import Wiring, wiring_of
from sb3_sparse.callbacks.initial import initial_state, sparse_policy_of
from sb3_sparse.callbacks.interval import IntervalCallback, check_whole
from sb3_sparse.engine.moments import clear_moments
from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import plain_names
from sb3_sparse.sparsity.numeric import is_number

Mask = NDArray[np.bool_]


class RecycleDormantCallback(IntervalCallback):
    """Gives dormant units new incoming weights every so many gradient steps: ReDo.

    A unit is dormant if its mean ``|activation|`` over a batch of the replay buffer is at most
    ``tau`` times the mean of its layer. Its incoming weights are drawn as at the start, its
    outgoing weights and its bias become 0, and so do the optimizer's moments of all these. Masks do
    not change: only active weights are drawn. Step counts, which torch keeps for a whole tensor,
    parameters of normalisation layers and target networks stay as they are.

    It works beside any topology method, on masked and on sparse storage, between gradient steps,
    which stay fused. Batches and weights are drawn from (mask seed, gradient step), and no global
    generator advances.

    Units are the outputs of activation functions that are modules (SB3's are) and lie between two
    linear or convolutional layers. Those of sums, such as the stream of a residual network, are
    left alone.

    A check that is due after the last gradient step of a training takes place when it ends.

    Logged: ``redo/dormant/<network>`` (share of its hidden units that the last check found dormant
    and recycled).

    Example::

        from sb3_sparse import DQN, RecycleDormantCallback

        kwargs = dict(sparsity=0.9, net_arch=[16, 16])
        model = DQN("SparsePolicy", "CartPole-v1", learning_starts=10, policy_kwargs=kwargs)
        model.learn(100, callback=RecycleDormantCallback(interval=20))

    :param interval: gradient steps between two checks
    :param tau: threshold of dormancy, 0 or more; None: 0.025 for discrete actions, 0.1 for others
    :param batch_size: observations, drawn from the replay buffer
    :param verbose: as in SB3
    :raises ConfigError: for a value that is not allowed; when training begins, for a policy that is
        not sparse or an algorithm without a replay buffer

    Source: arXiv:2302.12902, algorithm 1.
    """

    def __init__(
        self,
        interval: int = 1000,
        *,
        tau: float | None = None,
        batch_size: int = 256,
        verbose: int = 0,
    ) -> None:
        super().__init__(interval, verbose)
        check_whole(batch_size=batch_size)
        if tau is not None and not (is_number(tau) and tau >= 0):
            raise ConfigError(f"tau must be a number, 0 or more, got {tau!r}")
        self.tau = tau
        self.batch_size = batch_size

    def _init_callback(self) -> None:
        super()._init_callback()
        sparse_policy_of(self.model, self)
        self._wiring: dict[str, Wiring] | None = None

    def act(self, step: int) -> None:
        """Recycle the units that are dormant now."""
        policy, tau = sparse_policy_of(self.model, self), self.tau
        if tau is None:
            tau = 0.025 if isinstance(self.model.action_space, spaces.Discrete) else 0.1
        seed = (policy.sparse.seed * 1_000_003 + step) % 2**32
        batch = sample_batch(self.model, self.batch_size, seed)
        discrete = isinstance(self.model.action_space, spaces.Discrete)
        found = activity(self.model, batch.observations, None if discrete else batch.actions)
        if self._wiring is None:
            self._wiring = wiring_of(policy, batch.observations)
        dormant: dict[str, Mask] = {}
        for network, one in found.items():
            units = {
                name: means <= tau * means.mean()
                for name, means in zip(one.names, one.activations, strict=True)
                if name in self._wiring
            }
            if units:
                share = np.concatenate(list(units.values())).mean()
                self.logger.record(f"redo/dormant/{network}", float(share))
            dormant |= {name: which for name, which in units.items() if which.any()}
        if dormant:
            recycle(policy, self._wiring, dormant, step)


def recycle(
    policy: BaseSparsePolicy, wiring: dict[str, Wiring], dormant: dict[str, Mask], step: int
) -> None:
    """Recycle units of a policy.

    :param policy: the policy
    :param wiring: as :func:`wiring_of` returns it
    :param dormant: whether each unit is to be recycled, by the name of its activation function
    :param step: gradient step, which addresses the draw of weights
    """
    fresh = initial_state(policy, step)
    layers = _Layers(policy)
    for name, which in dormant.items():
        layers.redraw(wiring[name].incoming, which, fresh)
    for name, which in dormant.items():  # later: what a recycled unit reads of another is 0, too
        for layer, units in wiring[name].outgoing.items():
            layers.cut(layer, np.append(which, False)[units])


class _Layers:
    """Reads and writes weights of layers in any storage, by name."""

    def __init__(self, policy: BaseSparsePolicy) -> None:
        self.policy = policy
        self.optimizers = policy.sparse.optimizers
        self.kept = {id(layer.module): layer for layer in policy.sparse.layers}
        parameters = plain_names(dict(policy.named_parameters()))  # of shared ones, the first name
        self.names = {id(parameter): name for name, parameter in parameters.items()}

    def redraw(self, name: str, rows: Mask, fresh: dict[str, th.Tensor]) -> None:
        """Take the incoming weights of units from ``fresh``; set their biases to 0."""
        module = self.policy.get_submodule(name)
        drawn = fresh[self.names[id(module.get_parameter("weight"))]].cpu().numpy()
        weight = self._dense(module)
        weight[rows] = drawn[rows]
        where = np.zeros(weight.shape, dtype=np.bool_)
        where[rows] = True
        self._write(module, weight, where)
        bias = getattr(module, "bias", None)
        if isinstance(bias, nn.Parameter):
            with th.no_grad():
                bias[th.from_numpy(rows).to(bias.device)] = 0.0
            clear_moments(bias, rows, self.optimizers)

    def cut(self, name: str, columns: Mask) -> None:
        """Set the weights of inputs to 0."""
        module = self.policy.get_submodule(name)
        weight = self._dense(module)
        weight[:, columns] = 0.0
        where = np.zeros(weight.shape, dtype=np.bool_)
        where[:, columns] = True
        self._write(module, weight, where)

    def _dense(self, module: nn.Module) -> NDArray[np.float32]:
        """Return a copy of a layer's weight, 0 where inactive."""
        layer = self.kept.get(id(module))
        if layer is not None:
            return np.array(layer.dense().reshape(layer.shape))
        return np.array(module.get_parameter("weight").detach().cpu().numpy())

    def _write(self, module: nn.Module, weight: NDArray[np.float32], where: Mask) -> None:
        """Write a dense weight, and clear the moments of what has changed in it."""
        layer = self.kept.get(id(module))
        if layer is not None:
            layer.write(th.from_numpy(weight))
            layer.clear_moments(where.ravel(), self.optimizers)
            return
        parameter = module.get_parameter("weight")
        with th.no_grad():
            parameter.copy_(th.from_numpy(weight))
        clear_moments(parameter, where, self.optimizers)
