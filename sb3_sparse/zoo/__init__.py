"""Training runs in the style of the RL zoo: specifying, training, resuming and reading them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sb3_sparse.lazy import lazily

if TYPE_CHECKING:
    from sb3_sparse.zoo.archive import Archive
    from sb3_sparse.zoo.card import Card
    from sb3_sparse.zoo.configs import config_path
    from sb3_sparse.zoo.folder import RunFolder
    from sb3_sparse.zoo.inspection import inspect_model
    from sb3_sparse.zoo.record import Record, Status
    from sb3_sparse.zoo.results import Outcome
    from sb3_sparse.zoo.saved import SavedModel
    from sb3_sparse.zoo.scoring import enjoy
    from sb3_sparse.zoo.settings import Settings
    from sb3_sparse.zoo.spec import RunSpec
    from sb3_sparse.zoo.training import resume, train
    from sb3_sparse.zoo.watch import Watch

__all__ = [
    "Archive",
    "Card",
    "Outcome",
    "Record",
    "RunFolder",
    "RunSpec",
    "SavedModel",
    "Settings",
    "Status",
    "Watch",
    "config_path",
    "enjoy",
    "inspect_model",
    "resume",
    "train",
]
__getattr__, __dir__ = lazily(__name__)
