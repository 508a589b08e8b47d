"""The schedule of mask updates, validated on creation."""

from __future__ import annotations

from dataclasses import dataclass

from sb3_sparse.errors import ConfigError, warn
from sb3_sparse.sparsity.numeric import is_number, is_whole
from sb3_sparse.sparsity.schedules import cosine_drop_fraction
from sb3_sparse.topology import MaskUpdate, TopologyMethod, method_named, method_names

UPDATE_ON = ("step", "rollout")


@dataclass(frozen=True)
class Plan:
    """Schedules the mask updates of one method.

    :param method: a registered name
    :param update_interval: gradient steps of a network's own optimizer between two updates
    :param drop_fraction: share of a layer's connections exchanged at the first update, in [0, 1]
    :param begin: progress (environment steps done / planned) at which updates begin
    :param end: progress at which updates end
    :param update_on: ``"step"``: at the gradient step itself; ``"rollout"``: at the next start of a
        rollout
    :raises ConfigError: for an invalid value
    """

    method: str
    update_interval: int
    drop_fraction: float
    begin: float
    end: float
    update_on: str

    def __post_init__(self) -> None:
        method_named(self.method)
        if not is_whole(self.update_interval) or self.update_interval < 1:
            raise ConfigError(
                "update_interval must be a whole number of gradient steps, 1 or more, "
                f"got {self.update_interval!r}"
            )
        if not is_number(self.drop_fraction) or not 0.0 <= self.drop_fraction <= 1.0:
            raise ConfigError(f"drop_fraction must lie in [0, 1], got {self.drop_fraction!r}")
        if not (is_number(self.begin) and is_number(self.end) and 0 <= self.begin < self.end <= 1):
            raise ConfigError(
                "begin and end are fractions of training with 0 <= begin < end <= 1, "
                f"got begin={self.begin!r}, end={self.end!r}"
            )
        if self.update_on not in UPDATE_ON:
            raise ConfigError(
                f"update_on must be one of {', '.join(UPDATE_ON)}, got {self.update_on!r}"
            )

    @property
    def topology(self) -> TopologyMethod:
        """The registered method."""
        return method_named(self.method)

    @property
    def wants_gradients(self) -> bool:
        """Whether an update needs dense gradients, for its scores or for grown connections."""
        return self.topology.grows or self.topology.needs_gradient

    def update_at(self, step: int, progress: float, seed: int) -> MaskUpdate:
        """Describe an update at a gradient step to the method."""
        return MaskUpdate(step, progress, self.begin, self.end, self.drop_fraction, seed)

    def drop_fraction_at(self, progress: float) -> float:
        """Compute the present drop fraction; 0 for a method that exchanges nothing."""
        if not self.topology.grows:
            return 0.0
        return cosine_drop_fraction(progress, self.drop_fraction, self.end)

    def due(self, step: int, progress: float) -> bool:
        """Whether an update is due at this gradient step."""
        return step % self.update_interval == 0 and self.begin <= progress < self.end


def warn_of_no_plan(sparsity: float) -> None:
    """Warn that a policy trains at a lower sparsity than requested, and stays there.

    :param sparsity: its present sparsity
    """
    pruning = [name for name in method_names() if method_named(name).reaches_final]
    either = " or ".join(f"SparsityCallback({name!r})" for name in pruning)
    warn(
        f"the policy trains at sparsity {sparsity:.3g}, denser than requested, and nothing prunes "
        f"it: pass {either} to learn(), or leave out initial_sparsity to start at the requested "
        "sparsity"
    )
