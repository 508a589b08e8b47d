"""Studies: small YAML files that say what to train, and what runs them to their end."""

from sb3_sparse.experiments.runner import Progress, run_study
from sb3_sparse.experiments.spec import Study, study_names
from sb3_sparse.experiments.standing import CellStanding, standing_of

__all__ = ["CellStanding", "Progress", "Study", "run_study", "standing_of", "study_names"]
