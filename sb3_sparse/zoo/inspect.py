"""Looking into a saved model without running anything that its file says."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sb3_sparse.engine.auto import choose
from sb3_sparse.loading.zips import check_state, look_into
from sb3_sparse.policies.report import SparsityReport
from sb3_sparse.zoo.folder import arguments_of, is_run, model_in, zip_path
from sb3_sparse.zoo.outline import outline_of
from sb3_sparse.zoo.positions import image_in


@dataclass(frozen=True)
class Inspection:
    """What a saved model is.

    :param report: its layers
    :param compact: names of the layers that ``compute="auto"`` lets compute on their non-zeros here
    :param compute: what it was made with
    """

    report: SparsityReport
    compact: tuple[str, ...]
    compute: str

    def __str__(self) -> str:
        parts = [str(self.report), ""]
        if self.compute != "auto":
            parts.append(f"The model was made with compute={self.compute!r}.")
        elif self.compact:
            parts.append(f"compute='auto' computes on non-zeros here: {', '.join(self.compact)}")
        else:
            parts.append("compute='auto' keeps masks: no linear layer is large and sparse enough")
        return "\n".join(parts)


def inspect_model(path: Path) -> Inspection:
    """The sparsity report of a saved model, and how its layers are computed here.

    Nothing is unpickled and no class that the file names is imported, so that a stranger's file can
    be looked into.

    :param path: a run's folder, or a zip that SB3 saved, whichever algorithm trained it
    :raises ConfigError: if there is no such file, or no sparse policy in it
    :raises CorruptStateError: if the file is damaged
    :raises Diverged: if the network is not finite
    """
    path = path if is_run(path) else zip_path(path)  # a run has a folder of its environment's name
    if path.is_dir():
        path = model_in(path, arguments_of(path)["env"], False)
    contents = look_into(path)
    check_state(contents.state, str(path))
    data = contents.data
    image = image_in(data.get("observation_space"))
    outline = outline_of(contents.state, image, str(path))
    kwargs = data.get("policy_kwargs")
    compute = kwargs.get("compute", "auto") if isinstance(kwargs, dict) else "auto"
    names = {layer.name for layer in outline.layers}
    return Inspection(
        report=outline.report,
        compact=tuple(choose(outline.root, outline.layers, names)),
        compute=str(compute),
    )
