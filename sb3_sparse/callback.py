"""The callback that moves masks."""

from __future__ import annotations

from collections.abc import Mapping

from stable_baselines3.common.callbacks import BaseCallback

from sb3_sparse.engine.controller import Controller
from sb3_sparse.engine.network import SparseNetwork
from sb3_sparse.engine.plan import Plan
from sb3_sparse.engine.plans import Plans
from sb3_sparse.errors import ConfigError, warn
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.internals import planned_timesteps
from sb3_sparse.topology import TopologyMethod, method_named, method_names


class SparsityCallback(BaseCallback):
    """Moves the masks of a sparse policy while it trains, and logs its sparsity.

    To resume a training, load the model and pass the same callback again. Without a callback masks
    stay as they are, which is static sparse training.

    Logged: ``sparsity/total``, ``sparsity/<network>``, ``sparsity/nnz``, ``sparsity/mask_updates``,
    ``sparsity/mask_churn`` (share of the active connections that the last update dropped),
    ``sparsity/drop_fraction`` (the largest of any network; where networks differ, also
    ``sparsity/<network>_drop_fraction``) and ``sparsity/sparse_storage_layers`` (how many layers
    store their active connections only).

    Each argument but ``verbose`` is one value for all networks, or a mapping of networks to values.
    A network that no mapping of methods names is static::

        SparsityCallback({"actor": "static", "critic": "rigl"}, update_interval={"critic": 500})

    Example::

        from sb3_sparse import SAC, SparsityCallback

        kwargs = dict(sparsity=0.9, net_arch=[32, 32])
        model = SAC("SparsePolicy", "Pendulum-v1", learning_starts=10, policy_kwargs=kwargs)
        model.learn(40, callback=SparsityCallback("rigl", update_interval=10))

    :param method: ``"static"``, ``"set"``, ``"rigl"``, ``"prune"``, ``"granet"`` or one of your own
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
        means nothing for the method; when training begins, for a network that the policy lacks, or
        one whose method would not bring it from its initial sparsity to its final one

    Source: arXiv:2206.10369, sections 2.1 and A.3; a method for each network, arXiv:2510.12096.
    """

    def __init__(
        self,
        method: str | Mapping[str, str],
        *,
        update_interval: int | Mapping[str, int] = 1000,
        drop_fraction: float | Mapping[str, float] = 0.5,
        begin: float | None | Mapping[str, float | None] = None,
        end: float | Mapping[str, float] = 0.8,
        update_on: str | Mapping[str, str] = "step",
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        options = {
            "update_interval": update_interval,
            "drop_fraction": drop_fraction,
            "begin": begin,
            "end": end,
            "update_on": update_on,
        }
        usual = SparsityCallback.__init__.__kwdefaults__ or {}
        self.plans = Plans.of(method, options, {name: usual[name] for name in options})

    def _sparse_policy(self) -> BaseSparsePolicy:
        policy = unwrapped(self.model.policy)
        if not isinstance(policy, BaseSparsePolicy):
            raise ConfigError(
                f"SparsityCallback needs a sparse policy, got {type(policy).__name__}; make the "
                'model with SparsePolicy, e.g. SAC("SparsePolicy", env, '
                "policy_kwargs=dict(sparsity=0.9))"
            )
        return policy

    def _networks_by_plan(self, sparse: Controller) -> dict[Plan, list[SparseNetwork]]:
        found: dict[Plan, list[SparseNetwork]] = {}
        for network in sparse.networks:
            found.setdefault(self.plans[network.name], []).append(network)
        return found

    def _init_callback(self) -> None:
        policy = self._sparse_policy()
        self.plans.check([network.name for network in policy.sparse.networks])
        for plan, networks in self._networks_by_plan(policy.sparse).items():
            if plan.topology.reaches_final:
                _check_starts_denser(policy, plan.topology, networks)
            else:
                _check_starts_sparse(policy, plan.topology, networks)
        policy.sparse.drop_plans()  # left by an interrupted training

    def _on_training_start(self) -> None:
        sparse = self._sparse_policy().sparse
        if sparse.has_plans:
            sparse.drop_plans()
            raise ConfigError("two SparsityCallbacks are at work on one model; keep one")
        model, began = self.model, self.model.start_time  # every learn() sets it anew
        sparse.start(
            self.plans,
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
        if not sparse.has_plans:
            return  # rl_zoo3 calls it twice
        sparse.stop()
        self._log()
        self._warn_if_nothing_was_due()

    def _warn_if_nothing_was_due(self) -> None:
        for plan, networks in self._networks_by_plan(self._sparse_policy().sparse).items():
            resumed = self._began > 0.0
            static = [n for n in networks if not n.updates_due and not (resumed and n.mask_updates)]
            if not plan.topology.options or self._began >= plan.end or not static:
                continue
            steps = (f"{n.name}: {n.clock - self._clocks[n.name]} steps" for n in static)
            whose = "" if static == networks else f" of {', '.join(n.name for n in static)}"
            warn(
                f"{plan.method!r} had no mask update{whose}, so this was static training. An "
                f"update is due at every {plan.update_interval}th gradient step of a network "
                f"between {plan.begin:.0%} and {plan.end:.0%} of training, and none fell there ("
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
        plans = {network.name: self.plans[network.name] for network in networks}
        fractions = {name: plan.drop_fraction_at(sparse.progress) for name, plan in plans.items()}
        record("sparsity/drop_fraction", max(fractions.values()))
        if len(set(plans.values())) > 1:
            for name, fraction in fractions.items():
                record(f"sparsity/{name}_drop_fraction", fraction)
        record("sparsity/sparse_storage_layers", sum(layer.is_sparse for layer in sparse.layers))


def _check_starts_denser(
    policy: BaseSparsePolicy, method: TopologyMethod, networks: list[SparseNetwork]
) -> None:
    """Require something to prune of a method that prunes, in each network that ends sparse.

    :param networks: those that the method prunes
    """
    final = policy.sparsity_config.by_network({n.name: n.size for n in policy.sparse.networks})
    idle = [n for n in networks if all(x.initial_nnz == x.final_nnz for x in n.layers)]
    if len(idle) < len(networks) and all(final[n.name] == 0 for n in idle):
        return
    starts = {n.name: method.initial_sparsity(final[n.name]) for n in networks}
    alike = len(networks) == len(final) and len(set(starts.values())) == 1
    start = next(iter(starts.values())) if alike else starts
    share = f" ({method.initial_share:.0%} of the sparsity)" if method.initial_share else ""
    raise ConfigError(
        f"method {method.name!r} needs a policy that starts denser than it ends, and "
        f"{', '.join(n.name for n in idle)} would not: give a sparsity above 0 and "
        f"initial_sparsity={start} in policy_kwargs{share}"
    )


def _check_starts_sparse(
    policy: BaseSparsePolicy, method: TopologyMethod, networks: list[SparseNetwork]
) -> None:
    """Reject a denser start of networks that a method does not prune."""
    denser = [network.name for network in networks if network.denser]
    if not denser:
        return
    pruning = [repr(name) for name in method_names() if method_named(name).reaches_final]
    raise ConfigError(
        f"the policy starts at initial_sparsity={policy.sparsity_config.initial_sparsity}, and "
        f"method {method.name!r} of {', '.join(denser)} would never take it to its sparsity; use "
        f"{' or '.join(pruning)}, or leave initial_sparsity out there"
    )
