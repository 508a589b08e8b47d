"""Whole gradient steps for sparse_compute.py: SB3's ``train()``, dense and sparse."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

import gymnasium as gym
import torch as th
from compute_rows import rows_of
from gymnasium import spaces
from random_env import IMAGE, TORQUES, VECTOR, RandomEnv
from rounds import interleaved
from stable_baselines3 import DQN, PPO, SAC, TD3
from step_overhead import fused_like_stock, off_policy, on_policy

from sb3_sparse.engine.layer import SparseLayer
from sb3_sparse.networks import ImpalaCNN, ScaledNatureCNN
from sb3_sparse.sparsity import equivalent_widths

Variant = tuple[Any, Callable[[], None], int]
"""A model, a function that takes gradient steps, and their number."""
ALGOS = {
    "SAC": (SAC, RandomEnv(VECTOR, TORQUES), 256),
    "TD3": (TD3, RandomEnv(VECTOR, TORQUES), 256),
    "DQN": (DQN, RandomEnv(VECTOR, spaces.Discrete(4)), 128),
    "PPO": (PPO, RandomEnv(VECTOR, TORQUES), 64),
}


@dataclass(frozen=True)
class Case:
    """Models of one algorithm and network.

    :param sizes: widths of the layers, or channels of the convolutions and units
    :param steps: gradient steps in one timing
    :param arguments: makes policy arguments of sizes
    :param dense: name of SB3's policy
    :param sparse: arguments of the sparse policy alone
    """

    name: str
    algo: Any
    env: gym.Env
    batch: int
    sizes: tuple[int, ...]
    steps: int
    arguments: Callable[[Sequence[int]], dict[str, Any]]
    dense: str = "MlpPolicy"
    sparse: Mapping[str, Any] = field(default_factory=dict)

    def make(self, policy: str, **kwargs: Any) -> Variant:
        """Make a model that has collected what it trains with."""
        settings = self.arguments(self.sizes)
        if self.algo is PPO:
            rollout = self.batch * self.steps
            maker = on_policy(self.algo, self.env, self.batch, rollout, **settings)
        else:
            maker = off_policy(self.algo, self.env, self.batch, self.steps, **settings)
        found: Variant = maker(policy, kwargs)
        return found

    def make_sparse(self, sparsity: float, compute: str) -> Variant:
        """Make a model with the sparse policy."""
        return self.make("SparsePolicy", sparsity=sparsity, compute=compute, **self.sparse)

    def with_sparse(self, label: str, **kwargs: Any) -> Case:
        """Add arguments of the sparse policy, and a label to the name."""
        return replace(self, name=f"{self.name} {label}", sparse={**self.sparse, **kwargs})

    def narrow(self, parameters: int) -> Case:
        """Scale the sizes such that the dense network has so many parameters."""

        def count(sizes: Sequence[int]) -> int:
            buffer = {} if self.algo is PPO else {"buffer_size": 1}
            kwargs = self.arguments(sizes)
            model = self.algo(self.dense, self.env, policy_kwargs=kwargs, **buffer)
            groups = [group for o in optimizers(model) for group in o.param_groups]
            trained = {id(p): p for group in groups for p in group["params"]}
            return sum(p.numel() for p in trained.values())

        return replace(self, sizes=tuple(equivalent_widths(self.sizes, count, parameters)[0]))


def of_vectors(algo: str, width: int, activation: str | None = None) -> Case:
    """Make the case of two equal layers on vectors."""
    kind, env, batch = ALGOS[algo]
    steps = max(2, min(20, round(20 * (256 / width) ** 2)))
    extra = {} if activation is None else {"activation_fn": getattr(th.nn, activation)}
    name = f"{algo} {width}" if activation is None else f"{algo} {width} {activation}"
    return Case(
        name, kind, env, batch, (width, width), steps, lambda s: dict(extra, net_arch=list(s))
    )


EXTRACTORS = {"nature": (ScaledNatureCNN, 5), "impala": (ImpalaCNN, 1)}
"""Networks for images, and the gradient steps of one timing."""
CHANNELS = (32, 64, 64, 512)
"""Channels of three convolutions or stacks, and units of the layer behind them, in both."""


def of_images(net: str) -> Case:
    """Make the case of DQN with a network for images."""
    extractor, steps = EXTRACTORS[net]

    def arguments(sizes: Sequence[int]) -> dict[str, Any]:
        *channels, units = sizes
        if net == "nature" and tuple(sizes) == CHANNELS:
            return {}  # SB3's own
        return {
            "features_extractor_class": extractor,
            "features_extractor_kwargs": dict(channels=tuple(channels), features_dim=units),
            "net_arch": [],
        }

    env = RandomEnv(IMAGE, spaces.Discrete(6))
    return Case(f"DQN {net}", DQN, env, 32, CHANNELS, steps, arguments, "CnnPolicy")


def optimizers(model: Any) -> list[th.optim.Optimizer]:
    found = {id(o): o for m in model.policy.modules() if (o := getattr(m, "optimizer", None))}
    return list(found.values())


def state_bytes(model: Any) -> int:
    """Count the bytes of parameters, targets, moments, gradients, masks and indices."""
    policy = model.policy
    tensors = {id(t): t for t in (*policy.parameters(), *policy.buffers())}
    for parameter in policy.parameters():
        if parameter.grad is not None:
            tensors[id(parameter.grad)] = parameter.grad
    structures = {}
    for module in policy.modules():
        if isinstance(module, SparseLayer):
            structures[id(module.structure)] = module.structure
        optimizer = getattr(module, "optimizer", None)
        for state in optimizer.state.values() if optimizer is not None else ():
            tensors.update({id(t): t for t in state.values() if isinstance(t, th.Tensor)})
    return sum(t.nbytes for t in tensors.values()) + sum(s.nbytes for s in structures.values())


def time_steps(
    case: Case, sparsities: list[float], rounds: int, bf16: bool
) -> Iterator[dict[str, Any]]:
    """Time gradient steps at each sparsity beside their rivals."""
    for sparsity in sparsities:
        stock = case.make(case.dense)
        fused = fused_like_stock(stock[0])
        variants: dict[str, Variant] = {
            "dense, stock": stock,
            "dense, fused Adam": case.make(case.dense, **fused),
            **{name: case.make_sparse(sparsity, name) for name in ("masked", "sparse", "auto")},
        }
        report = variants["masked"][0].policy.sparsity_report()
        if sparsity:
            narrow = case.narrow(report.parameters)
            variants[f"narrow dense {narrow.sizes[0]}"] = narrow.make(case.dense, **fused)
        context: dict[str, Any] = {}
        if bf16:
            variants["dense bf16"] = case.make(case.dense, **fused)
            context["dense bf16"] = lambda: th.autocast("cpu", dtype=th.bfloat16)

        def timed(name: str, train: Callable[[], None], context=context) -> Callable[[], None]:
            def run() -> None:
                with context.get(name, nullcontext)():
                    train()

            return run

        trains = {name: timed(name, train) for name, (_, train, _) in variants.items()}
        times = interleaved(trains, rounds)
        for row in rows_of("step", case.name, case.batch, sparsity, times, case.steps):
            model, _, _ = variants[row["variant"]]
            yield {**row, "megabytes": state_bytes(model) / 1e6}
        del variants, trains, stock
        gc.collect()
