"""Signal-to-noise ratio of gradients."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from torch import nn
from torch.func import functional_call, grad, vmap

from sb3_sparse.analysis.batches import own_randomness, sample_batch
from sb3_sparse.analysis.losses import Loss, losses_for, unchecked_distributions
from sb3_sparse.analysis.measurement import MeasurementCallback
from sb3_sparse.analysis.networks import connections, dense_twin, parameters_by_network
from sb3_sparse.engine.internals import pytree
from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.sparsity.numeric import is_whole

CHUNK_NUMBERS = 2**23
"""Numbers that the per-sample gradients of one chunk may have."""


@dataclass(frozen=True)
class NetworkSNR:
    """Signal-to-noise ratio of the gradients of one network.

    Example::

        from sb3_sparse import DQN
        from sb3_sparse.analysis import gradient_snr

        kwargs = dict(sparsity=0.9, net_arch=[16])
        model = DQN("SparsePolicy", "CartPole-v1", learning_starts=10, policy_kwargs=kwargs)
        snr = gradient_snr(model.learn(40), batch_size=8)["q_net"]
        print(snr.all, snr.active, snr.inactive)

    :param network: name of the network
    :param all: mean over all parameters: active and inactive connections, biases, log_std
    :param active: mean over active connections
    :param inactive: mean over inactive connections; None: there are none
    """

    network: str
    all: float
    active: float
    inactive: float | None


@dataclass(frozen=True)
class GradientSNR:
    """Signal-to-noise ratios of the gradients of all networks of a model.

    Example::

        from sb3_sparse import PPO
        from sb3_sparse.analysis import gradient_snr

        kwargs = dict(sparsity=0.9, net_arch=[16])
        kwargs = dict(n_steps=32, batch_size=16, policy_kwargs=kwargs)
        model = PPO("SparsePolicy", "CartPole-v1", **kwargs)
        print(gradient_snr(model.learn(32), batch_size=8).values())

    :param networks: the ratios of each network
    :param samples: size of the minibatch
    """

    networks: tuple[NetworkSNR, ...]
    samples: int

    def __getitem__(self, network: str) -> NetworkSNR:
        return {one.network: one for one in self.networks}[network]

    def values(self) -> dict[str, float]:
        """All ratios, by the names under which they are logged."""
        found: dict[str, float] = {}
        for one in self.networks:
            name = f"snr/{one.network}"
            found |= {name: one.all, f"{name}/active": one.active}
            if one.inactive is not None:
                found[f"{name}/inactive"] = one.inactive
        return found

    def __str__(self) -> str:
        rows = "\n".join(f"{name}: {value:.4g}" for name, value in self.values().items())
        return f"{rows}\n(over {self.samples} samples)"


class _OfSample(nn.Module):
    """A loss as a module, as ``functional_call`` needs it."""

    def __init__(self, policy: nn.Module, loss: Loss) -> None:
        super().__init__()
        self.policy = policy
        self.loss = loss

    def forward(self, sample: dict[str, Any]) -> th.Tensor:
        return self.loss.of_sample(self.policy, sample)


def per_sample_gradients(
    twin: nn.Module, loss: Loss, names: list[str], chunk: int | None = None
) -> Iterator[dict[str, th.Tensor]]:
    """Gradients of the loss of each sample, a chunk of samples at a time.

    :param twin: policy with dense weights
    :param loss: loss and samples
    :param names: names of the parameters
    :param chunk: samples at a time; None: as many as fit into a few dozen MB
    :return: gradients by name, shape ``(samples, *shape of the dense parameter)``
    """
    parameters = dict(twin.named_parameters())
    wanted = {f"policy.{name}": parameters[name].detach() for name in names}
    module = _OfSample(twin, loss)

    def of_sample(weights: dict[str, th.Tensor], sample: Any) -> th.Tensor:
        value: th.Tensor = functional_call(module, weights, (sample,))
        return value

    gradients = vmap(grad(of_sample), in_dims=(None, 0))
    samples = len(pytree.tree_leaves(loss.samples)[0])
    if chunk is None:
        chunk = max(1, CHUNK_NUMBERS // sum(p.numel() for p in wanted.values()))
    for start in range(0, samples, chunk):
        part = pytree.tree_map(lambda t, s=slice(start, start + chunk): t[s], loss.samples)
        with unchecked_distributions():
            found = gradients(wanted, part)
        yield {name.removeprefix("policy."): value for name, value in found.items()}


def gradient_snr(
    model: BaseAlgorithm,
    batch: Any = None,
    *,
    batch_size: int | None = None,
    seed: int = 0,
    chunk: int | None = None,
) -> GradientSNR:
    """Signal-to-noise ratio of the gradients of single samples of one minibatch.

    The ratio of a parameter is ``|mean| / (std + 1e-10)`` over the gradients of the algorithm's own
    loss for each sample (population std); a network's is the mean over its parameters. Inactive
    connections take part with their dense gradient. As in SB3, advantages of PPO are normalised
    over the minibatch, targets of DQN and SAC come from the target networks, and actions of SAC are
    drawn anew. Gradients are taken before clipping and without weight decay. Batch normalisation
    and dropout are in evaluation mode, because single samples have no batch statistics.

    The model does not change, nor do the global generators of NumPy and torch.

    :param model: a model of DQN, SAC, PPO or an algorithm with
        :func:`~sb3_sparse.analysis.losses.register_losses`, its policy sparse or stock
    :param batch: SB3's named tuple of a replay or rollout buffer; None: one is drawn as ``train()``
        does, from the replay buffer or the last rollout
    :param batch_size: samples to draw; None: as many as the algorithm takes
    :param seed: seed of random draws
    :param chunk: samples whose gradients are in memory at once; None: depends on their size
    :raises ConfigError: for another algorithm, or a model whose buffers are empty

    Source: arXiv:2206.10369, section on the signal-to-noise ratio.
    """
    losses = losses_for(type(model))
    for name, value in {"batch_size": batch_size, "chunk": chunk}.items():
        if value is not None and (not is_whole(value) or value < 1):
            raise ConfigError(f"{name} must be an integer, 1 or more, got {value!r}")
    if batch is None:
        batch = sample_batch(model, batch_size, seed)
    elif batch_size is not None:
        raise ConfigError("batch_size means nothing for a batch that is given")
    policy = unwrapped(model.policy)
    twin, names, masks = dense_twin(policy), parameters_by_network(policy), connections(policy)
    results: dict[str, NetworkSNR] = {}
    with own_randomness(seed + 1, model.device):
        with th.no_grad():
            made = losses(model, twin, batch)
        for loss in made:
            trained = [name for network in loss.networks for name in names[network]]
            statistics: dict[str, RunningMeanStd] = {}
            for gradients in per_sample_gradients(twin, loss, trained, chunk):
                for name, each in gradients.items():
                    one = statistics.setdefault(name, RunningMeanStd(0.0, each.shape[1:]))
                    one.update(each.double().cpu().numpy())
            for network in loss.networks:
                snr = {name: _ratios(statistics[name]) for name in names[network]}
                results[network] = _means(network, snr, masks)
    in_order = tuple(results[name] for name in names)
    return GradientSNR(in_order, len(pytree.tree_leaves(batch._asdict())[0]))


def _ratios(gradients: RunningMeanStd) -> th.Tensor:
    ratios = np.abs(gradients.mean) / (np.sqrt(gradients.var) + 1e-10)
    return th.from_numpy(ratios).flatten()


def _means(network: str, snr: Mapping[str, th.Tensor], masks: Mapping[str, Any]) -> NetworkSNR:
    active, inactive = [], []
    for name, values in snr.items():
        if name not in masks:
            continue  # a bias
        mask = masks[name]
        here = th.ones(len(values), dtype=th.bool) if mask is None else th.from_numpy(mask)
        active.append(values[here])
        inactive.append(values[~here])
    off = th.cat(inactive)
    return NetworkSNR(
        network,
        float(th.cat(list(snr.values())).mean()),
        float(th.cat(active).mean()),
        float(off.mean()) if len(off) else None,
    )


class GradientSNRCallback(MeasurementCallback):
    """Logs :func:`gradient_snr` while a model trains, without changing the training.

    Logged: ``snr/<network>``, ``snr/<network>/active`` and, where there are inactive connections,
    ``snr/<network>/inactive``. To resume a training, pass the same callback again.

    Example::

        from sb3_sparse import DQN
        from sb3_sparse.analysis import GradientSNRCallback

        kwargs = dict(sparsity=0.9, net_arch=[16])
        model = DQN("SparsePolicy", "CartPole-v1", learning_starts=10, policy_kwargs=kwargs)
        model.learn(40, callback=GradientSNRCallback(every=20, batch_size=8, path="snr.csv"))

    :param every: environment steps between two measurements; DQN and SAC are measured once learning
        has started, PPO at the end of a rollout, before it trains on it
    :param batch_size: samples; None: as many as the algorithm's minibatch has
    :param path: CSV file, see :class:`~sb3_sparse.analysis.measurement.MeasurementCallback`
    :param verbose: as in SB3
    :raises ConfigError: for a value that is not allowed or another algorithm
    """

    def __init__(
        self,
        every: int,
        batch_size: int | None = None,
        path: str | Path | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(every, path, verbose)
        if batch_size is not None and (not is_whole(batch_size) or batch_size < 1):
            raise ConfigError(f"batch_size must be an integer, 1 or more, got {batch_size!r}")
        self.batch_size = batch_size

    def _init_callback(self) -> None:
        losses_for(type(self.model))

    def measure(self, seed: int) -> Mapping[str, float]:
        return gradient_snr(self.model, batch_size=self.batch_size, seed=seed).values()
