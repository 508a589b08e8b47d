"""How a run computes, for its record: what was requested, what was chosen, and on what.

Equal seeds give equal runs where all of this is equal: instruction sets and threads determine
the order in which numbers are added, and so how they are rounded.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space

from sb3_sparse.algorithms.base import Fused
from sb3_sparse.engine.native.library import in_use, why_missing
from sb3_sparse.errors import CorruptStateError
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.report import COMPUTES, SPARSE
from sb3_sparse.zoo.record import CURE, Record

FUSED, OWN = "fused", "SB3's own"
"""The two ways in which gradient steps run."""
FORMER = {"non-zeros": SPARSE}
"""Older records' words for how a layer computes, and today's."""


@dataclass(frozen=True)
class Session:
    """A stretch of training in one process.

    :param num_timesteps: environment steps at its start
    :param instructions: instruction set of the kernels; None: they are not compiled
    :param torch_instructions: instruction set of torch's own kernels
    :param threads: number of threads of torch, and so of the kernels
    :param layers: how each layer computed at its start, by name
    :param gradient_steps: how gradient steps ran then, as :func:`gradient_steps_of` returns it
    """

    num_timesteps: int
    instructions: str | None
    torch_instructions: str
    threads: int
    layers: Mapping[str, str]
    gradient_steps: str = OWN  # the default for records that lack it

    def __str__(self) -> str:
        sparse = sum(how == SPARSE for how in self.layers.values())
        kernels = "no kernels" if self.instructions is None else f"{self.instructions} kernels"
        threads = "1 thread" if self.threads == 1 else f"{self.threads} threads"
        return (
            f"from step {self.num_timesteps}: {sparse} of {len(self.layers)} layers in sparse "
            f"storage, {kernels}, torch's {self.torch_instructions}, {threads}, gradient steps "
            f"{self.gradient_steps}"
        )


@dataclass(frozen=True)
class Computing:
    """How a run computed.

    :param asked: the policy's ``compute``
    :param sittings: its sessions in order, under the name that records have for them
    """

    asked: str
    sittings: tuple[Session, ...]


def gradient_steps_of(model: BaseAlgorithm) -> str:
    """Return how a model's gradient steps run: ``"fused"``, or ``"SB3's own"`` and why."""
    if not isinstance(model, Fused):
        return f"{OWN}: {type(model).__name__} has no others"
    why = model.why_not_fused()
    return FUSED if why is None else f"{OWN}: {why}"


def computing_at(model: BaseAlgorithm, record: Record) -> dict[str, Any]:
    """Return the record's entry on how a run computes, at the start of a session.

    Earlier sessions that began at the model's step or later are dropped: they were killed before
    their first checkpoint.

    :param model: a model with a sparse policy
    :param record: the run's record so far
    """
    policy = unwrapped(model.policy)
    assert isinstance(policy, BaseSparsePolicy)
    known = computing_in(record)
    now = Session(
        model.num_timesteps,
        None if why_missing() else in_use(),
        th.backends.cpu.get_cpu_capability(),
        th.get_num_threads(),
        {layer.name: layer.compute for layer in policy.sparsity_report().layers},
        gradient_steps_of(model),
    )
    before = () if known is None else known.sittings
    earlier = [one for one in before if one.num_timesteps < model.num_timesteps]
    return asdict(Computing(policy.sparsity_config.compute, (*earlier, now)))


def computing_in(record: Record) -> Computing | None:
    """Read from a record how its run computed; None in records of older versions.

    :raises CorruptStateError: if the record is damaged
    """
    if "computing" not in record:
        return None
    with record.reading():
        found = record["computing"]
        sittings = tuple(
            Session(**{**one, "layers": _read(one["layers"])}) for one in found["sittings"]
        )
        for one in sittings:
            if type(one.num_timesteps) is not int:
                raise CorruptStateError(f"a session began at step {one.num_timesteps!r}")
            if not isinstance(one.gradient_steps, str):
                raise CorruptStateError(f"its gradient steps were {one.gradient_steps!r}")
        return Computing(str(found["asked"]), sittings)


def layers_in(record: Record) -> dict[tuple[str, int], str]:
    """Read from a record how each layer computed when it was last saved, by name and nnz.

    :return: an empty mapping for records of older versions
    :raises CorruptStateError: if the record is damaged
    """
    with record.reading():
        layers = [one for one in record.get("layers", []) if "compute" in one]
        how = _read({str(one["name"]): one["compute"] for one in layers})
        return {(str(one["name"]), int(one["nnz"])): how[str(one["name"])] for one in layers}


def _read(layers: Mapping[str, Any]) -> dict[str, str]:
    """Translate how each layer computes into today's words.

    :raises CorruptStateError: for an unknown word
    """
    found = {name: FORMER.get(how, how) for name, how in layers.items()}
    for name, how in found.items():
        if how not in COMPUTES:
            raise CorruptStateError(
                f"{name} computes {how!r}, but allowed are {', '.join(COMPUTES)}; {CURE}"
            )
    return found


def counts_of(policy: BaseSparsePolicy) -> dict[str, Any]:
    """Count a policy's connections, parameters and FLOPs: in total, by network and by layer.

    ``wanted_nnz`` counts the active connections that its settings ask for.
    """
    report = policy.sparsity_report()
    networks = dict.fromkeys(layer.network for layer in report.layers)
    return {
        "total": {
            "sparsity": report.sparsity(),
            "nnz": report.nnz,
            "wanted_nnz": report.nnz + sum(one.final_nnz - one.nnz for one in policy.sparse.layers),
            "parameters": report.parameters,
            "flops": sum(layer.flops for layer in report.layers),
            "dense_flops": sum(layer.dense_flops for layer in report.layers),
        },
        "networks": {name: {"sparsity": report.sparsity(name)} for name in networks},
        "layers": [
            {**asdict(layer), "size": layer.size, "density": layer.density}
            for layer in report.layers
        ],
    }


def use_few_threads(observation_space: spaces.Space[Any]) -> None:
    """Use one thread for networks without convolutions, which more threads only slow down.

    ``OMP_NUM_THREADS`` takes precedence if it is set.
    """
    images = isinstance(observation_space, spaces.Dict) or is_image_space(observation_space)
    if "OMP_NUM_THREADS" not in os.environ and not images:
        th.set_num_threads(1)


@contextmanager
def denormals_as_zero() -> Iterator[None]:
    """Treat numbers below 1.2e-38 as 0 in this thread.

    Weight decay drives the weights of units that never fire, and their Adam moments, into
    denormal numbers, which slow a processor down: after a few thousand steps, a gradient step of
    the paper's dense DQN takes 29 instead of 4 ms.
    """
    before = (th.tensor(1e-38) * 1e-2).item() == 0.0
    th.set_flush_denormal(True)
    try:
        yield
    finally:
        th.set_flush_denormal(before)
