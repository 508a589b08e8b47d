"""When masks move and how far: what a user configures, checked when made."""

from __future__ import annotations

from dataclasses import dataclass

from sb3_sparse.errors import ConfigError
from sb3_sparse.sparsity.schedules import cosine_drop_fraction
from sb3_sparse.topology import Moment, TopologyMethod, method_named

UPDATE_ON = ("step", "rollout")


def _number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


@dataclass(frozen=True)
class Plan:
    """The schedule of one method.

    :param method: a registered name
    :param update_interval: gradient steps of a network's own optimizer between two updates
    :param drop_fraction: share of a layer's connections exchanged at the first update, in [0, 1]
    :param begin: progress (environment steps done / planned) at which updates begin
    :param end: progress at which they end
    :param update_on: ``"step"``: at the gradient step that is due; ``"rollout"``: at the next start
        of a rollout
    :raises ConfigError: for a value that is not allowed
    """

    method: str
    update_interval: int
    drop_fraction: float
    begin: float
    end: float
    update_on: str

    def __post_init__(self) -> None:
        method_named(self.method)
        if type(self.update_interval) is not int or self.update_interval < 1:
            raise ConfigError(
                "update_interval must be a whole number of gradient steps, 1 or more, "
                f"got {self.update_interval!r}"
            )
        if not _number(self.drop_fraction) or not 0.0 <= self.drop_fraction <= 1.0:
            raise ConfigError(f"drop_fraction must lie in [0, 1], got {self.drop_fraction!r}")
        if not (_number(self.begin) and _number(self.end) and 0 <= self.begin < self.end <= 1):
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
        """The method itself."""
        return method_named(self.method)

    def moment(self, step: int, progress: float, seed: int) -> Moment:
        """The moment that a method is handed."""
        return Moment(step, progress, self.begin, self.end, self.drop_fraction, seed)

    def drop_fraction_at(self, progress: float) -> float:
        """The drop fraction now; 0 for a method that exchanges nothing."""
        if not self.topology.grows:
            return 0.0
        return cosine_drop_fraction(progress, self.drop_fraction, self.end)

    def due(self, step: int, progress: float) -> bool:
        """Whether the schedule has an update at this gradient step."""
        return step % self.update_interval == 0 and self.begin <= progress < self.end
