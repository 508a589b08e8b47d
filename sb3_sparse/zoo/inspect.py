"""Looking into a saved model without running anything that its file says."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch as th

from sb3_sparse.engine.auto import Choice, choose
from sb3_sparse.errors import CorruptStateError
from sb3_sparse.loading.zips import CURE, check_state, look_into
from sb3_sparse.policies.report import SparsityReport
from sb3_sparse.zoo.folder import arguments_of, is_run, model_in, zip_path
from sb3_sparse.zoo.outline import outline_of
from sb3_sparse.zoo.positions import image_in


@dataclass(frozen=True)
class Inspection:
    """What a saved model is.

    :param report: its layers
    :param choice: what ``compute="auto"`` would choose on this machine
    :param compute: what it was made with
    """

    report: SparsityReport
    choice: Choice
    compute: str

    def __str__(self) -> str:
        parts = [str(self.report), "", f"On this machine {self.choice}"]
        if self.choice.layers:
            parts.append(self.choice.table())
        if self.compute != "auto":
            parts.append(f"The model was made with compute={self.compute!r}, so nothing is chosen.")
        return "\n".join(parts)


def inspect_model(path: Path) -> Inspection:
    """The sparsity report of a saved model, and how its layers would best be computed here.

    Nothing is unpickled and no class that the file names is imported, so that a stranger's file can
    be looked into.

    :param path: a run's folder, or a zip that SB3 saved, whichever algorithm trained it
    :raises ConfigError: if there is no such file, or no sparse policy in it
    :raises CorruptStateError: if the file is damaged
    :raises Diverged: if the network is not finite
    """
    if is_run(path) or path.is_dir():
        path = model_in(path, arguments_of(path)["env"], False)
    path = zip_path(path)
    contents = look_into(path)
    check_state(contents.state, str(path))
    data = contents.data
    image = image_in(data.get("observation_space"))
    outline = outline_of(contents.state, image, str(path))
    kwargs = data.get("policy_kwargs")
    compute = kwargs.get("compute", "auto") if isinstance(kwargs, dict) else "auto"
    batch = _batch(data, path)
    if "OMP_NUM_THREADS" not in os.environ and image is None:
        th.set_num_threads(1)
    return Inspection(
        report=outline.report,
        choice=choose(outline.root, outline.layers, batch),
        compute=str(compute),
    )


def _batch(data: dict[str, Any], path: Path) -> int:
    """Entries of a minibatch; of A2C, the whole rollout."""
    batch = data.get("batch_size")
    if batch is None:
        steps, envs = data.get("n_steps"), data.get("n_envs")
        batch = steps * envs if isinstance(steps, int) and isinstance(envs, int) else None
    if type(batch) is not int or not 0 < batch < 2**24:
        raise CorruptStateError(f"{path} is damaged: its batch size is {batch!r}; {CURE}")
    return batch
