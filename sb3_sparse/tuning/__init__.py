"""Tuning with Optuna: the paper's grids and beyond, from one process to many machines."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sb3_sparse.lazy import lazily

if TYPE_CHECKING:
    from sb3_sparse.tuning.objective import Objective
    from sb3_sparse.tuning.report import write_report
    from sb3_sparse.tuning.shipped import paper_space, wide_space
    from sb3_sparse.tuning.spacefile import space_of
    from sb3_sparse.tuning.spaces import Space
    from sb3_sparse.tuning.storage import open_storage
    from sb3_sparse.tuning.tuner import Tuned, tune

__all__ = [
    "Objective",
    "Space",
    "Tuned",
    "open_storage",
    "paper_space",
    "space_of",
    "tune",
    "wide_space",
    "write_report",
]
__getattr__, __dir__ = lazily(__name__)
