"""Studies: small YAML files that say what to train, and what runs them to their end."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_sparse.experiments.blocks import study_names
    from sb3_sparse.experiments.runner import Progress, run_study
    from sb3_sparse.experiments.spec import Study
    from sb3_sparse.experiments.standing import CellStanding, standing_of

__all__ = ["CellStanding", "Progress", "Study", "run_study", "standing_of", "study_names"]
_HOMES = {
    "CellStanding": "standing",
    "Progress": "runner",
    "Study": "spec",
    "run_study": "runner",
    "standing_of": "standing",
    "study_names": "blocks",
}


def __getattr__(name: str) -> Any:
    # Not at once: what lists studies needs none of what trains them.
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
