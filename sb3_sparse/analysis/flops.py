"""Floating-point operations of policies, sparse or stock, acting and training."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_sparse.algorithms.table import nearest
from sb3_sparse.analysis.networks import modules_of, prunable_of, specs_of
from sb3_sparse.engine.network import SparseNetwork
from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.registry import registered
from sb3_sparse.policies.report import LayerReport, SparsityReport, build_report, table_lines
from sb3_sparse.policies.spec import PassCounts
from sb3_sparse.sparsity.numeric import is_whole


@dataclass(frozen=True)
class LayerFlops:
    """FLOPs of one layer.

    Example::

        from sb3_sparse import DQN
        from sb3_sparse.analysis import flops

        model = DQN("SparsePolicy", "CartPole-v1", policy_kwargs=dict(sparsity=0.9))
        first = flops(model).layers[0]
        print(first.name, first.forward, first.dense_forward)

    :param network: name of the network that the layer belongs to
    :param name: dotted name within the policy
    :param shape: weight shape, torch order
    :param nnz: active connections
    :param forward: FLOPs of a forward pass at batch 1
    :param dense_forward: the same for the dense layer
    :param step: FLOPs of a gradient step with the whole minibatch; None: only a policy was given
    :param dense_step: the same for the dense layer
    """

    network: str
    name: str
    shape: tuple[int, ...]
    nnz: int
    forward: int
    dense_forward: int
    step: float | None
    dense_step: float | None


@dataclass(frozen=True)
class FlopsReport:
    """FLOPs of all layers; ``print`` it for a table.

    Example::

        from sb3_sparse import SAC
        from sb3_sparse.analysis import flops

        model = SAC("SparsePolicy", "Pendulum-v1", policy_kwargs=dict(sparsity=0.9))
        report = flops(model)
        print(report.forward("actor") / report.dense_forward("actor"), report.step())

    :param layers: every layer once; the steps of target networks are in those of their originals
    :param algorithm: name of the algorithm whose gradient step was counted; None: none was
    :param batch_size: size of its minibatch
    :param passes: how often it runs each network
    """

    layers: tuple[LayerFlops, ...]
    algorithm: str | None = None
    batch_size: int | None = None
    passes: tuple[PassCounts, ...] = ()

    @property
    def networks(self) -> tuple[str, ...]:
        """Names of the networks."""
        return tuple(dict.fromkeys(layer.network for layer in self.layers))

    def forward(self, network: str | None = None) -> int:
        """FLOPs of one forward pass at batch 1, of one network or of all."""
        return sum(layer.forward for layer in self._of(network))

    def dense_forward(self, network: str | None = None) -> int:
        """As :meth:`forward`, without sparsity."""
        return sum(layer.dense_forward for layer in self._of(network))

    def step(self, network: str | None = None) -> float:
        """FLOPs of one gradient step, of one network or of all.

        :raises ConfigError: if only a policy was given, which has no gradient steps
        """
        return sum(self._counted(layer.step) for layer in self._of(network))

    def dense_step(self, network: str | None = None) -> float:
        """As :meth:`step`, without sparsity.

        :raises ConfigError: if only a policy was given
        """
        return sum(self._counted(layer.dense_step) for layer in self._of(network))

    def _of(self, network: str | None) -> list[LayerFlops]:
        if network not in (None, *self.networks):
            raise ConfigError(f"no network {network!r}; there are {', '.join(self.networks)}")
        return [layer for layer in self.layers if network in (None, layer.network)]

    @staticmethod
    def _counted(step: float | None) -> float:
        if step is None:
            raise ConfigError("a policy alone has no gradient step; call flops with the model")
        return step

    def __str__(self) -> str:
        heads = ["layer", "shape", "forward", "of dense"]
        rows = [
            [r.name, "x".join(map(str, r.shape)), *_share(r.forward, r.dense_forward)]
            for r in self.layers
        ]
        ends: list[str | None] = [*self.networks, None]
        rows += [
            [name or "total", "", *_share(self.forward(name), self.dense_forward(name))]
            for name in ends
        ]
        if self.algorithm is not None:
            heads += ["gradient step", "of dense"]
            steps = [(r.step or 0.0, r.dense_step or 0.0) for r in self.layers]
            steps += [(self.step(name), self.dense_step(name)) for name in ends]
            rows = [row + _share(*step) for row, step in zip(rows, steps, strict=True)]
        note = "FLOPs, forward at batch 1"
        if self.algorithm is not None:
            note += f"; gradient step of {self.algorithm} at batch {self.batch_size}"
        return "\n".join([*table_lines([heads, *rows]), note])


def _share(flops: float, dense: float) -> list[str]:
    return [f"{flops:,.0f}", f"{flops / dense:.3f}" if dense else "-"]


def flops(
    policy_or_model: BasePolicy | BaseAlgorithm, batch_size: int | None = None
) -> FlopsReport:
    """Count the FLOPs of any SB3 policy, and of a gradient step if a model is given.

    A multiply-add counts 2, a bias and an activation 1 each. Sparse layers count their active
    connections, for each output position, as if zeros cost nothing. A LayerNorm counts 7 for each
    unit (5 without scale and shift), and the sum of a SimBa block 1; both count with the layer
    before them.

    For each sample of the minibatch, a gradient step counts 1 for a forward pass, also of a target
    network, 2 for a backward pass of a network that is trained, and 1 for the gradient that the
    actor gets through a critic. (There, stock SB3 computes the critic's own gradients too and
    throws them away, which does not count.) How often each network runs is declared where the
    algorithm is registered. Optimizers, averaging of targets, batch normalisation, losses and
    RigL's dense gradients do not count.

    :param policy_or_model: sparse or stock, with any features extractor of Linear and Conv layers
    :param batch_size: size of the minibatch; None: the model's
    :raises UnsupportedError: for a policy whose networks are not known
    :raises ConfigError: for a model whose algorithm's passes are not known, or a batch size without
        a model

    Source: arXiv:2206.10369; a gradient step counts as three forward passes as in arXiv:1911.11134.
    """
    policy_or_model = unwrapped(policy_or_model)
    if isinstance(policy_or_model, BasePolicy):
        if batch_size is not None:
            raise ConfigError("batch_size means nothing for a policy; call flops with the model")
        return FlopsReport(tuple(_layer(r, None) for r in _report(policy_or_model).layers))
    model = policy_or_model
    passes = passes_of(model)
    size = batch_size_of(model) if batch_size is None else batch_size
    if not is_whole(size) or size < 1:
        raise ConfigError(f"batch_size must be an integer, 1 or more, got {size!r}")
    policy = unwrapped(model.policy)
    times = _times(policy, passes)
    layers = tuple(_layer(r, size * times[r.name]) for r in _report(policy).layers)
    return FlopsReport(layers, type(model).__name__, size, tuple(passes))


def passes_of(model: BaseAlgorithm) -> list[PassCounts]:
    """The passes of one gradient step, with the model's own settings.

    :raises ConfigError: for an algorithm whose ``train()`` is none of the known ones
    """
    known = {one.algorithm: one.passes for one in registered().values() if one.passes is not None}
    passes = nearest(type(model), known)
    if passes is not None:
        return passes(model)
    raise ConfigError(
        f"how often {type(model).__name__} runs its networks in a gradient step is not known; it "
        f"is known for {', '.join(one.__name__ for one in known)}. Give its passes to "
        "sb3_sparse.register_policy, or call flops(model.policy), which counts forward passes alone"
    )


def batch_size_of(model: Any) -> int:
    """Size of the model's minibatch."""
    if hasattr(model, "batch_size"):
        return int(model.batch_size)
    return int(model.n_steps * model.n_envs)  # A2C takes the whole rollout


def _layer(r: LayerReport, times: float | None) -> LayerFlops:
    step = None if times is None else times * r.flops
    dense = None if times is None else times * r.dense_flops
    return LayerFlops(r.network, r.name, r.shape, r.nnz, r.flops, r.dense_flops, step, dense)


def _report(policy: BasePolicy) -> SparsityReport:
    """The sparsity report; all layers of a stock policy count as left dense."""
    if isinstance(policy, BaseSparsePolicy):
        return policy.sparsity_report()
    owned = _owned(policy)
    return build_report(
        policy, [SparseNetwork(name, policy, [], list(owned[name].items())) for name in owned]
    )


def _owned(policy: BasePolicy) -> dict[str, dict[str, Any]]:
    """Layers by network; a shared layer belongs to the first."""
    seen: set[int] = set()
    found: dict[str, dict[str, Any]] = {}
    for network, spec in specs_of(policy).items():
        layers = prunable_of(policy, spec)
        found[network] = {n: m for n, m in layers.items() if id(m) not in seen}
        seen.update(map(id, layers.values()))
    return found


def _times(policy: BasePolicy, passes: list[PassCounts]) -> dict[str, float]:
    """The work of each layer in one gradient step, in forward passes of one sample."""
    specs, owned = specs_of(policy), _owned(policy)
    names = {id(m): name for layers in owned.values() for name, m in layers.items()}
    times = dict.fromkeys(names.values(), 0.0)
    for one in passes:
        modules = modules_of(policy, specs[one.network])
        extractors = [m for m in modules.values() if isinstance(m, BaseFeaturesExtractor)]
        before_actions = {id(m) for extractor in extractors for m in extractor.modules()}
        for name, module in prunable_of(policy, specs[one.network]).items():
            own = name in owned[one.network]
            if fnmatchcase(name, one.leaves_out) or not (own or one.shares):
                continue
            through = 0.0 if id(module) in before_actions else one.through
            backward = 2 * one.backward if own else 0.0
            times[names[id(module)]] += one.forward + backward + through
    return times
