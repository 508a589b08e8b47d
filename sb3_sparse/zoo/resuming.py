"""What a run resumes from is looked at before anything is replaced."""

from __future__ import annotations

from pathlib import Path

from sb3_sparse.loading.statistics import read_statistics
from sb3_sparse.loading.zips import read_model
from sb3_sparse.zoo.attributes import check_attributes
from sb3_sparse.zoo.folder import VECNORMALIZE, RunFolder
from sb3_sparse.zoo.saved import SavedModel
from sb3_sparse.zoo.spec import RunSpec


def check_start(start: Path, run: RunSpec) -> None:
    """Reject a model or statistics that training cannot resume from.

    :param start: folder of a checkpoint, or of the run
    :param run: the run to resume
    :raises ConfigError: if there is no model
    :raises CorruptStateError: if model or statistics are damaged
    :raises Diverged: if model or statistics are not finite
    """
    parameters = RunFolder(start).parameters(run.env_id)
    saved = SavedModel(parameters.with_name(f"{parameters.name}.zip"), run.algo)
    saved.load()
    check_attributes(saved.path, run.algo, read_model(saved.path)[0])
    if (parameters / VECNORMALIZE).is_file():
        read_statistics(parameters / VECNORMALIZE)
