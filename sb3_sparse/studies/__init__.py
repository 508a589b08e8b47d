"""Studies: small YAML files of runs to train, and the runner that completes them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sb3_sparse.lazy import lazily

if TYPE_CHECKING:
    from sb3_sparse.studies.blocks import study_names
    from sb3_sparse.studies.runner import Progress, run_study
    from sb3_sparse.studies.spec import Study
    from sb3_sparse.studies.status import CellStatus, status_of

__all__ = ["CellStatus", "Progress", "Study", "run_study", "status_of", "study_names"]
__getattr__, __dir__ = lazily(__name__)
