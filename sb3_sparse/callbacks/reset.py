"""The callback that resets networks periodically."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from stable_baselines3.common.utils import polyak_update
from torch import nn

from sb3_sparse.callbacks.initial import initial_state, sparse_policy_of, tensors_by_name
from sb3_sparse.callbacks.interval import IntervalCallback
from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import plain_names
from sb3_sparse.policies.internals import updates_done
from sb3_sparse.policies.spec import DENSE_WORDS, in_target, input_layers, matches, output_layers


class ResetCallback(IntervalCallback):
    """Initialises networks, or some of their layers, anew every so many gradient steps.

    The replay buffer, masks and clocks stay. Weights and biases are drawn as at the start, with the
    present masks; the optimizer forgets its state of them, and target networks become copies. The
    temperature of SAC and its optimizer stay.

    It works beside any topology method, on masked and on sparse storage, between gradient steps,
    which stay fused. Weights are drawn from (mask seed, gradient step), and no global generator
    advances. A reset that is due after the last round of gradient steps takes place when the
    training is resumed, so it does not end with an untrained policy; steps that were trained
    without the callback make none due.

    Logged: ``reset/count`` (resets that were due so far).

    Example::

        from sb3_sparse import SAC, ResetCallback

        kwargs = dict(sparsity=0.9, net_arch=[32, 32])
        model = SAC("SparsePolicy", "Pendulum-v1", learning_starts=10, policy_kwargs=kwargs)
        model.learn(60, callback=ResetCallback(interval=20, layers=["output"]))

    :param interval: gradient steps between two resets
    :param layers: layers to reset, as in ``dense_layers``: the words ``"input"`` and ``"output"``,
        names, or patterns of names; None: all layers, and all other parameters and statistics of
        the networks
    :param verbose: as in SB3
    :raises ConfigError: for a value that is not allowed; when training begins, for a policy that is
        not sparse, an algorithm without a replay buffer, or a pattern that matches no layer

    Source: arXiv:2205.07802, section 4.
    """

    acts_at_end = False  # or the training would end with an untrained policy

    def __init__(
        self, interval: int = 200_000, *, layers: Sequence[str] | None = None, verbose: int = 0
    ) -> None:
        super().__init__(interval, verbose)
        named = () if layers is None else layers
        if isinstance(named, str) or not all(isinstance(one, str) for one in named):
            raise ConfigError(
                f"layers must be a list of names, such as ['output'], or None, got {layers!r}"
            )
        if layers is not None and not layers:
            raise ConfigError("layers must name one at least; leave it out to reset all")
        self.layers = None if layers is None else tuple(layers)

    def _init_callback(self) -> None:
        super()._init_callback()
        layers_named(sparse_policy_of(self.model, self), self.layers)

    def act(self, step: int) -> None:
        """Reset the networks now."""
        policy = sparse_policy_of(self.model, self)
        reset(policy, layers_named(policy, self.layers), step)
        self.logger.record("reset/count", updates_done(self.model) // self.interval)


def layers_named(policy: BaseSparsePolicy, patterns: Sequence[str] | None) -> set[str] | None:
    """Return the names of the layers that patterns match; None for None.

    :raises ConfigError: if one matches none
    """
    if patterns is None:
        return None
    found: set[str] = set()
    unmatched, known = set(patterns), []
    for network in policy.sparse.networks:
        spec = policy.networks[network.name]
        names = [layer.name for layer in network.layers]
        names += [name for name, _ in network.dense_layers]
        order = list(plain_names(dict(policy.named_modules(remove_duplicate=False))))
        names.sort(key=order.index)
        known += names
        words = {"input": input_layers(policy, spec, names), "output": output_layers(spec, names)}
        for pattern in patterns:
            matched = words[pattern] if pattern in DENSE_WORDS else set()
            matched |= {name for name in names if matches(name, [pattern])}
            found |= matched
            unmatched -= {pattern} if matched else set()
    if unmatched:
        raise ConfigError(
            f"layers has {', '.join(map(repr, sorted(unmatched)))}, which matches no layer of this "
            f"policy; its layers are {', '.join(known)}, or use the words 'input' and 'output'"
        )
    return found


def reset(policy: BaseSparsePolicy, names: set[str] | None, step: int) -> None:
    """Initialise a policy's layers anew, with their present masks.

    :param names: names of the layers; None: all, and all other trained parameters and the
        statistics of normalisation
    :param step: gradient step, which addresses the draw
    """
    fresh = initial_state(policy, step)
    kept = {id(layer.weight): layer for layer in policy.sparse.layers}
    chosen = {id(p) for name in names or () for p in policy.get_submodule(name).parameters()}
    for name, tensor in tensors_by_name(policy):
        left = names is not None and id(tensor) not in chosen
        frozen = isinstance(tensor, nn.Parameter) and not tensor.requires_grad
        if left or frozen or in_target(name, policy.networks):
            continue
        layer = kept.get(id(tensor))
        if layer is not None:
            layer.write(fresh[name])
        else:
            with th.no_grad():
                tensor.copy_(fresh[name])
        for optimizer in policy.sparse.optimizers:
            optimizer.state.pop(tensor, None)
    for spec in policy.networks.values():
        if spec.target is not None:
            for root in spec.roots:
                _copy(policy.get_submodule(root), policy.get_submodule(spec.target))


def _copy(network: nn.Module, target: nn.Module) -> None:
    """Make a target network a copy, as SB3 does."""
    with th.no_grad():
        polyak_update(network.parameters(), target.parameters(), 1.0)
