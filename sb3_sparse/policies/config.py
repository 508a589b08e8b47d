"""The sparse arguments of a policy."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch as th

from sb3_sparse.engine.native.library import library
from sb3_sparse.engine.optimizers import check_weight_decay
from sb3_sparse.errors import ConfigError
from sb3_sparse.sparsity.budgets import split_sparsity
from sb3_sparse.sparsity.distributions import check_distribution, check_sparsity
from sb3_sparse.sparsity.numeric import is_whole

COMPUTE = ("masked", "sparse", "auto")
SPARSITY_MISSING = (
    "a sparse policy needs its sparsity, e.g. policy_kwargs=dict(sparsity=0.9): the removed "
    "fraction of connections, in [0, 1). There is no default, so that a lost value cannot train "
    "dense (rl_zoo3.train -optimize loses it unless you add --gym-packages "
    "sb3_sparse.rl_zoo_optimize)"
)


@dataclass(frozen=True)
class SparsityConfig:
    """How sparse a policy is: the arguments that sparse policies take beside SB3's.

    :param sparsity: removed fraction of the weights, in [0, 1), for every network, or one for each
        network by name, e.g. ``{"actor": 0.95, "critic": 0.8}``; required
    :param initial_sparsity: sparsity at the start of training, e.g. 0.0 for pruning, of every
        network, or by network; None, or a network left out: as sparse as at the end
    :param distribution: ``"erk"``, ``"er"`` or ``"uniform"``
    :param actor_share: fraction of all remaining connections that the actor gets (all critics
        counted); None: actor and critic equally sparse
    :param dense_layers: layers left dense and outside the budget, by name pattern
        (``"actor.mu"``, ``"critic.qf*.4"``) or by the words ``"input"`` and ``"output"``
    :param sparsity_aware_init: scale initial weights by the connections that each unit has; a
        network that starts dense keeps SB3's initial weights
    :param weight_decay: coefficient of coupled L2 regularisation of the weights, not of biases
    :param mask_seed: seed of masks and growth; None: follows from SB3's ``seed``
    :param compute: ``"masked"``: dense weights and masks; ``"sparse"``: linear layers and
        convolutions store and compute only their active connections; ``"auto"``: large and sparse
        layers do, by a rule of shapes and counts (docs/compute.md)
    :raises ConfigError: for a value that is not allowed
    :raises MissingKernels: for ``compute="sparse"`` without compiled kernels
    """

    sparsity: float | Mapping[str, float] | None
    initial_sparsity: float | Mapping[str, float | None] | None = None
    distribution: str = "erk"
    actor_share: float | None = None
    dense_layers: Sequence[str] = ()
    sparsity_aware_init: bool = True
    weight_decay: float = 0.0
    mask_seed: int | None = None
    compute: str = "auto"

    def __post_init__(self) -> None:
        if self.sparsity is None:
            raise ConfigError(SPARSITY_MISSING)
        if isinstance(self.sparsity, Mapping):
            for name, value in self.sparsity.items():
                check_sparsity(value, f"sparsity of {name!r}")
            if self.actor_share is not None:
                raise ConfigError(
                    "actor_share divides one sparsity between both networks, but sparsity is given "
                    "for each network; give one number, or leave actor_share out"
                )
        else:
            check_sparsity(self.sparsity)
        for name, start in self._starts().items():
            if start is not None:
                of = f"initial_sparsity of {name!r}" if name else "initial_sparsity"
                check_sparsity(start, of)
        check_distribution(self.distribution)
        check_weight_decay(self.weight_decay, None)
        if not isinstance(self.dense_layers, (list, tuple)) or not all(
            isinstance(pattern, str) for pattern in self.dense_layers
        ):
            raise ConfigError(
                f'dense_layers must be a list of names, e.g. ["output"], got {self.dense_layers!r}'
            )
        if not isinstance(self.sparsity_aware_init, (bool, np.bool_)):
            raise ConfigError(
                f"sparsity_aware_init must be true or false, got {self.sparsity_aware_init!r}"
            )
        if self.mask_seed is not None and (not is_whole(self.mask_seed) or self.mask_seed < 0):
            raise ConfigError(
                f"mask_seed must be a whole number, 0 or more, got {self.mask_seed!r}"
            )

        if self.compute not in COMPUTE:
            raise ConfigError(
                f"compute must be one of {', '.join(map(repr, COMPUTE))}, got {self.compute!r}"
            )
        if self.compute == "sparse":
            library()

    def _starts(self) -> Mapping[str, float | None]:
        """The sparsity at the start by network; of all networks by the name ""."""
        given = self.initial_sparsity
        return given if isinstance(given, Mapping) else {"": given}

    @classmethod
    def pop_from(cls, kwargs: dict[str, Any]) -> SparsityConfig:
        """Make a config of the keyword arguments that are its fields, and remove these."""
        names = [one.name for one in fields(cls) if one.name in kwargs]
        return cls(**{"sparsity": None, **{name: kwargs.pop(name) for name in names}})

    def seed(self) -> int:
        """The mask seed: if none is given, the next number of torch's generator, not advanced."""
        if self.mask_seed is not None:
            return self.mask_seed
        generator = th.Generator()
        generator.set_state(th.get_rng_state())
        return int(th.randint(2**63 - 1, (), generator=generator))

    def check_names(self, networks: Collection[str]) -> None:
        """Check that the names in ``sparsity`` and ``initial_sparsity`` are those of networks.

        :param networks: names of all networks of the policy
        :raises ConfigError: if they are not
        """
        names = ", ".join(map(repr, networks))
        if isinstance(self.sparsity, Mapping) and set(self.sparsity) != set(networks):
            raise ConfigError(
                f"sparsity is given for {', '.join(repr(n) for n in self.sparsity)}; this "
                f"policy has the networks {names}: name each of them, or give one number"
            )
        unknown = [repr(name) for name in self._starts() if name and name not in networks]
        if unknown:
            raise ConfigError(
                f"initial_sparsity is given for {', '.join(unknown)}; this policy has the networks "
                f"{names}"
            )

    def by_network(self, sizes: Mapping[str, int]) -> dict[str, float]:
        """The sparsity of each network.

        :param sizes: dense connections of each network, within the budget
        :raises ConfigError: if names do not match or a share is infeasible
        """
        assert self.sparsity is not None
        self.check_names(sizes)
        if isinstance(self.sparsity, Mapping):
            return {name: check_sparsity(self.sparsity[name]) for name in sizes}
        if self.actor_share is None:
            return {name: check_sparsity(self.sparsity) for name in sizes}
        if set(sizes) != {"actor", "critic"}:
            names = ", ".join(map(repr, sizes))
            raise ConfigError(f"actor_share needs an actor and a critic; this policy has {names}")
        actor, critic = split_sparsity(
            sizes["actor"], sizes["critic"], self.sparsity, self.actor_share
        )
        return {"actor": actor, "critic": critic}

    def initial(self, network: str, final: float) -> float:
        """The sparsity that a network starts with.

        :param final: the sparsity that it ends with
        :raises ConfigError: if it would start sparser than it ends
        """
        starts = self._starts()
        start = starts.get(network, starts.get(""))
        if start is None:
            return final
        if start > final:
            raise ConfigError(
                f"initial_sparsity={start} is above the sparsity {final} of "
                f"{network!r}; pruning only removes, so start at or below it (0.0 is dense)"
            )
        return check_sparsity(start)
