"""The measures that a study takes of its runs, beside their evaluations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sb3_sparse.errors import ConfigError
from sb3_sparse.sparsity.numeric import is_number, is_whole
from sb3_sparse.zoo.record import Record

DURING = {"snr": ("every", "batch_size"), "plasticity": ("every",)}
AFTER = {"noise": ("sigmas", "n_episodes", "seeds")}
FILES = {"snr": "snr.csv", "plasticity": "plasticity.csv", "noise": "robustness.csv"}


@dataclass(frozen=True)
class Measures:
    """Measures and their arguments, by name.

    :param during: measures that callbacks take during training
    :param after: measures of the trained model
    """

    during: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    after: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, given: Any) -> Measures:
        """Parse a study's ``measures``, which map names to arguments.

        :raises ConfigError: for an unknown name or argument, or a value that is not allowed
        """
        if not isinstance(given, Mapping):
            raise ConfigError(
                f"measures must map names to arguments, e.g. snr: {{every: 10000}}, got {given!r}"
            )
        for name, arguments in given.items():
            allowed = {**DURING, **AFTER}
            if name not in allowed:
                raise ConfigError(f"unknown measure {name!r}; allowed are {', '.join(allowed)}")
            if not isinstance(arguments, Mapping) or not set(arguments) <= set(allowed[name]):
                raise ConfigError(
                    f"measure {name} takes {', '.join(allowed[name])}, got {arguments!r}"
                )
            for key, value in arguments.items():
                _check(f"{key} of measure {name}", value, key == "sigmas")
        return cls(
            {name: dict(given[name]) for name in DURING if name in given},
            {name: dict(given[name]) for name in AFTER if name in given},
        )

    def check(self, algorithm: type[Any]) -> None:
        """Reject an algorithm that does not support these measures.

        :raises ConfigError: naming the algorithms that do
        """
        if "snr" in self.during:
            from sb3_sparse.analysis.losses import losses_for

            losses_for(algorithm)

    def callbacks(self, folder: Path) -> list[Any]:
        """Make callbacks that write into a run's folder."""
        if not self.during:
            return []
        from sb3_sparse.analysis import GradientSNRCallback, PlasticityCallback

        classes = {"snr": GradientSNRCallback, "plasticity": PlasticityCallback}
        return [
            classes[name](**arguments, path=folder / FILES[name])
            for name, arguments in self.during.items()
        ]

    def missing(self, record: Record) -> dict[str, Mapping[str, Any]]:
        """Return the measures that a trained model still lacks.

        :param record: the record of its run
        """
        measured = record.measured
        return {name: given for name, given in self.after.items() if measured.get(name) != given}


def _check(what: str, value: Any, several: bool) -> None:
    """Reject values that would fail only after training."""
    if several:
        numbers = value if isinstance(value, list) else []
        if not numbers or not all(is_number(one) and one >= 0 for one in numbers):
            raise ConfigError(f"{what} must be a list of numbers, 0 or more, got {value!r}")
    elif not is_whole(value) or value < 1:
        raise ConfigError(f"{what} must be a whole number, 1 or more, got {value!r}")
