"""Studies: small YAML files that say what to train, and what runs them to their end."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sb3_sparse.lazy import lazily

if TYPE_CHECKING:
    from sb3_sparse.experiments.blocks import study_names
    from sb3_sparse.experiments.runner import Progress, run_study
    from sb3_sparse.experiments.spec import Study
    from sb3_sparse.experiments.standing import CellStanding, standing_of

__all__ = ["CellStanding", "Progress", "Study", "run_study", "standing_of", "study_names"]
__getattr__, __dir__ = lazily(
    __name__,
    {
        "CellStanding": "standing",
        "Progress": "runner",
        "Study": "spec",
        "run_study": "runner",
        "standing_of": "standing",
        "study_names": "blocks",
    },
)
