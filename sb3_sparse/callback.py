"""The callback that moves masks."""

from __future__ import annotations

from stable_baselines3.common.callbacks import BaseCallback

from sb3_sparse.engine.plan import Plan
from sb3_sparse.errors import ConfigError, warn
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.internals import planned_timesteps
from sb3_sparse.topology import method_named


class SparsityCallback(BaseCallback):
    """Moves the masks of a sparse policy while it trains, and logs its sparsity.

    To resume a training, load the model and pass the same callback again. Without a callback masks
    stay as they are, which is static sparse training.

    Logged: ``sparsity/total``, ``sparsity/<network>``, ``sparsity/nnz``, ``sparsity/mask_updates``,
    ``sparsity/mask_churn`` (share of the active connections that the last update dropped),
    ``sparsity/drop_fraction`` and ``sparsity/sparse_storage_layers`` (how many layers store their
    active connections only).

    Example::

        from sb3_sparse import SAC, SparsityCallback

        kwargs = dict(sparsity=0.9, net_arch=[32, 32])
        model = SAC("SparsePolicy", "Pendulum-v1", learning_starts=10, policy_kwargs=kwargs)
        model.learn(40, callback=SparsityCallback("rigl", update_interval=10))

    :param method: ``"static"``, ``"set"``, ``"rigl"``, ``"prune"`` or a registered one
    :param update_interval: gradient steps of a network's own optimizer between two updates
    :param drop_fraction: share of a layer's connections exchanged at the first update; decays to 0
        along a cosine
    :param begin: progress (environment steps done / planned) at which updates begin; None: the
        method's default, 0.2 for ``"prune"`` and 0 for the others
    :param end: progress at which they end
    :param update_on: ``"step"``: at the gradient step that is due; ``"rollout"``: at the start of
        the next rollout
    :param verbose: as in SB3
    :raises ConfigError: for an unknown method, a value that is not allowed or an argument that
        means nothing for the method

    Source: arXiv:2206.10369, sections 2.1 and A.3.
    """

    def __init__(
        self,
        method: str,
        *,
        update_interval: int = 1000,
        drop_fraction: float = 0.5,
        begin: float | None = None,
        end: float = 0.8,
        update_on: str = "step",
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        topology = method_named(method)
        given = {
            "update_interval": update_interval,
            "drop_fraction": drop_fraction,
            "begin": begin,
            "end": end,
            "update_on": update_on,
        }
        usual = SparsityCallback.__init__.__kwdefaults__ or {}
        changed = {name for name, value in given.items() if value != usual[name]}
        unused = sorted(changed - topology.options)
        if unused:
            raise ConfigError(
                f"method {method!r} has no {', '.join(unused)}; it takes "
                f"{', '.join(sorted(topology.options)) or 'no options'}"
            )
        begins = topology.default_begin if begin is None else begin
        self.plan = Plan(method, update_interval, drop_fraction, begins, end, update_on)

    def _sparse_policy(self) -> BaseSparsePolicy:
        policy = unwrapped(self.model.policy)
        if not isinstance(policy, BaseSparsePolicy):
            raise ConfigError(
                f"SparsityCallback needs a sparse policy, got {type(policy).__name__}; make the "
                'model with SparsePolicy, e.g. SAC("SparsePolicy", env, '
                "policy_kwargs=dict(sparsity=0.9))"
            )
        return policy

    def _init_callback(self) -> None:
        policy = self._sparse_policy()
        layers = list(policy.sparse.layers)
        if self.plan.topology.reaches_final and all(
            layer.initial_nnz == layer.final_nnz for layer in layers
        ):
            raise ConfigError(
                f"method {self.plan.method!r} needs a policy that starts denser than it ends: give "
                "a sparsity above 0 and initial_sparsity=0.0 in policy_kwargs"
            )
        denser = any(network.denser for network in policy.sparse.networks)
        if not self.plan.topology.reaches_final and denser:
            raise ConfigError(
                f"the policy starts at initial_sparsity={policy.sparsity_config.initial_sparsity}, "
                f"and method {self.plan.method!r} would never take it to its sparsity; use "
                "'prune', or leave initial_sparsity out"
            )
        policy.sparse.plan = None  # left by an interrupted training

    def _on_training_start(self) -> None:
        sparse = self._sparse_policy().sparse
        if sparse.plan is not None:
            sparse.plan = None
            raise ConfigError("two SparsityCallbacks are at work on one model; keep one")
        model, began = self.model, self.model.start_time  # every learn() sets it anew
        sparse.start(
            self.plan,
            soft_targets=getattr(model, "tau", 1.0) < 1.0,
            in_force=lambda: model.start_time == began,
        )
        self._note_progress()
        self._began = sparse.progress
        self._clocks = {network.name: network.clock for network in sparse.networks}

    def _on_rollout_start(self) -> None:
        self._sparse_policy().sparse.flush()

    def _on_step(self) -> bool:
        self._note_progress()
        return True

    def _on_rollout_end(self) -> None:
        self._log()

    def _on_training_end(self) -> None:
        self._note_progress()
        sparse = self._sparse_policy().sparse
        if sparse.plan is None:
            return  # rl_zoo3 calls it twice
        sparse.stop()
        self._log()
        self._warn_if_nothing_was_due()

    def _warn_if_nothing_was_due(self) -> None:
        sparse = self._sparse_policy().sparse
        reachable = self._began < self.plan.end
        if self.plan.topology.options and sparse.updates_due == 0 and reachable:
            steps = (f"{n.name}: {n.clock - self._clocks[n.name]} steps" for n in sparse.networks)
            warn(
                f"{self.plan.method!r} had no mask update, so this was static training. An update "
                f"is due at every {self.plan.update_interval}th gradient step of a network between "
                f"{self.plan.begin:.0%} and {self.plan.end:.0%} of training, and none fell there ("
                f"{', '.join(steps)}); train longer, choose a smaller update_interval or, where "
                "gradient steps begin late, a smaller learning_starts"
            )

    def _note_progress(self) -> None:
        planned = planned_timesteps(self.model)
        progress = self.model.num_timesteps / planned if planned else 1.0
        self._sparse_policy().sparse.progress = progress

    def _log(self) -> None:
        sparse = self._sparse_policy().sparse
        networks = sparse.networks
        record = self.logger.record
        record("sparsity/total", sparse.sparsity)
        for network in networks:
            record(f"sparsity/{network.name}", 1.0 - network.nnz / network.size)
        record("sparsity/nnz", sum(network.nnz for network in networks))
        record("sparsity/mask_updates", max(network.mask_updates for network in networks))
        record("sparsity/mask_churn", max(network.churn for network in networks))
        record("sparsity/drop_fraction", self.plan.drop_fraction_at(sparse.progress))
        record("sparsity/sparse_storage_layers", sum(layer.is_sparse for layer in sparse.layers))
