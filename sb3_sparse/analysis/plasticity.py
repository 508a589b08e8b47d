"""The callback that measures plasticity: dormant units, ranks, and moves of masks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from sb3_sparse.analysis.activity import activity, dormant_of, ranks_of
from sb3_sparse.analysis.batches import sample_batch
from sb3_sparse.analysis.maskhistory import MaskHistory
from sb3_sparse.analysis.measurement import MeasurementCallback
from sb3_sparse.analysis.networks import specs_of
from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped


class PlasticityCallback(MeasurementCallback):
    """Logs dormant units, effective ranks and, for sparse policies, how masks have moved.

    Logged: ``plasticity/dormant`` (share of all units), ``plasticity/dormant/<network>``,
    ``plasticity/effective_rank/<network>``, ``plasticity/mask_churn/<network>`` (fraction of all
    connections that have changed between active and inactive since the last measurement) and
    ``plasticity/exploration/<network>`` (fraction of all connections that have been active at a
    measurement so far, or at the start: the in-time over-parameterisation rate). A network without
    activation functions has no dormant share.

    The training does not change. Which connections have been active is saved beside ``path`` as
    ``<stem>.masks.npz``, from where a resumed run with the same callback continues; without
    ``path`` it counts from the start of this training. Let ``every`` be at most the interval of
    mask updates, or connections that come and go between two measurements are missed.

    Example::

        from sb3_sparse import DQN
        from sb3_sparse.analysis import PlasticityCallback

        kwargs = dict(sparsity=0.9, net_arch=[16])
        model = DQN("SparsePolicy", "CartPole-v1", learning_starts=10, policy_kwargs=kwargs)
        model.learn(40, callback=PlasticityCallback(every=20, path="plasticity.csv"))

    :param every: environment steps between two measurements
    :param path: CSV file, see :class:`~sb3_sparse.analysis.measurement.MeasurementCallback`
    :param batch_size: observations, drawn from the replay buffer or the last rollout; no effective
        rank exceeds it
    :param tau: threshold of dormancy
    :param delta: threshold of the effective rank
    :param verbose: as in SB3
    :raises ConfigError: for a value that is not allowed
    :raises UnsupportedError: for a policy whose networks are not known

    Source: arXiv:2302.12902 (dormant units), arXiv:2010.14498 (effective rank), arXiv:2102.02887
    (exploration).
    """

    def __init__(
        self,
        every: int,
        path: str | Path | None = None,
        batch_size: int = 1024,
        tau: float = 0.025,
        delta: float = 0.01,
        verbose: int = 0,
    ) -> None:
        super().__init__(every, path, verbose)
        if batch_size < 1 or not tau >= 0 or not 0 <= delta < 1:
            raise ConfigError(
                "batch_size must be 1 or more, tau 0 or more and delta in [0, 1), got "
                f"{batch_size!r}, {tau!r} and {delta!r}"
            )
        self.batch_size = batch_size
        self.tau = tau
        self.delta = delta
        self.history: MaskHistory | None = None

    def _init_callback(self) -> None:
        specs_of(self.model.policy)

    def _on_training_start(self) -> None:
        super()._on_training_start()
        policy = unwrapped(self.model.policy)
        self.history = None
        if isinstance(policy, BaseSparsePolicy):
            path = None if self.file is None else self.file.path.with_suffix(".masks.npz")
            self.history = MaskHistory(policy.sparse.networks, self.model.num_timesteps, path)

    def measure(self, seed: int) -> Mapping[str, float]:
        batch = sample_batch(self.model, self.batch_size, seed)
        off_policy = hasattr(batch, "next_observations")
        found = activity(self.model, batch.observations, batch.actions if off_policy else None)
        values: dict[str, float] = {}
        if any(one.activations for one in found.values()):
            dormant = dormant_of(found, self.tau)
            values["plasticity/dormant"] = dormant.overall
            values |= {f"plasticity/dormant/{k}": v for k, v in dormant.networks.items()}
        ranks = ranks_of(found, self.delta)
        values |= {f"plasticity/effective_rank/{name}": rank for name, rank in ranks.items()}
        if self.history is not None:
            for name, (churn, explored) in self.history.look(self.model.num_timesteps).items():
                values[f"plasticity/mask_churn/{name}"] = churn
                values[f"plasticity/exploration/{name}"] = explored
        return values
