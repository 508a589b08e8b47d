"""Inspects a saved model without running code that its file names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sb3_sparse.engine.auto import choose
from sb3_sparse.engine.sparse import storable
from sb3_sparse.loading.zips import check_state, look_into
from sb3_sparse.policies.report import SPARSE, SparsityReport
from sb3_sparse.policies.storage import KNOWN_PACKAGES
from sb3_sparse.zoo.computing import Computing, computing_in, layers_in
from sb3_sparse.zoo.folder import locate
from sb3_sparse.zoo.outline import Outline, outline_of
from sb3_sparse.zoo.positions import image_in


@dataclass(frozen=True)
class Inspection:
    """The content of a saved model.

    :param report: its layers. How each computes comes from the run's record if it has that, else
        from the model's settings and this machine's processor
    :param compute: the policy's ``compute`` argument
    :param computing: how the run computed, from its record; None: not known
    """

    report: SparsityReport
    compute: str
    computing: Computing | None = None

    def __str__(self) -> str:
        return "\n".join([str(self.report), "", *self._remarks()])

    def _remarks(self) -> list[str]:
        if self.computing is not None:
            sessions = [f"Trained {session}." for session in self.computing.sittings]
            return [f"The run asked for compute={self.computing.asked!r}.", *sessions]
        sparse = sum(layer.compute == SPARSE for layer in self.report.layers)
        if self.compute != "auto":
            return [f"The model was made with compute={self.compute!r}."]
        if sparse:
            of = len(self.report.layers)
            return [f"compute='auto': {sparse} of {of} layers in sparse storage here"]
        return ["compute='auto' keeps masks: no linear layer is large and sparse enough"]


def inspect_model(path: Path, best: bool = False) -> Inspection:
    """Report the sparsity of a saved model, and how its layers compute.

    Nothing is unpickled and no class that the file names is imported, so you can inspect files
    that you do not trust.

    :param path: a run's folder, or a zip that SB3 saved, with any algorithm
    :param best: take a folder's best policy instead of its last
    :raises ConfigError: if there is no such file, or it holds no sparse policy
    :raises CorruptStateError: if the file or the run's record is damaged
    :raises Diverged: if a network is not finite
    """
    path, folder = locate(path, best)
    computing, recorded = None, {}
    if folder.is_run and folder.has_record:
        record = folder.record()
        computing, recorded = computing_in(record), layers_in(record)
    contents = look_into(path)
    check_state(contents.state, str(path))
    outline = outline_of(
        contents.state, image_in(contents.data.get("observation_space")), str(path)
    )
    kwargs = contents.data.get("policy_kwargs")
    kwargs = kwargs if isinstance(kwargs, dict) else {}
    compute = str(kwargs.get("compute", "auto"))
    sparse = _sparse(compute, outline, contents.data.get("policy_class"), kwargs)
    layers = (
        replace(layer, compute=SPARSE) if layer.name in sparse else layer
        for layer in outline.report.layers
    )
    told = (replace(one, compute=recorded.get((one.name, one.nnz), one.compute)) for one in layers)
    return Inspection(SparsityReport(tuple(told)), compute, computing)


def _sparse(
    compute: str, outline: Outline, policy_class: object, kwargs: Mapping[str, Any]
) -> set[str]:
    """Return the names of the layers that a loaded model keeps in sparse storage.

    :param policy_class: the policy's class as the file writes it
    :param kwargs: the policy's arguments
    """
    names = {layer.name for layer in outline.layers}
    if compute == "sparse":
        # Shapes do not tell groups and dilation, so a grouped convolution counts as sparse here.
        return {layer.name for layer in outline.layers if storable(layer.module)}
    if compute != "auto" or not _known(policy_class):
        return set()
    if not _known(kwargs.get("features_extractor_class")):
        names = {name for name in names if "features_extractor." not in name}
    return set(choose(outline.root, outline.layers, names))


def _known(written: object) -> bool:
    """Whether a class in a file is known to only call its layers; None is the default class."""
    module = written.get("__module__") if isinstance(written, dict) else written
    if not isinstance(module, str):
        return True
    return module.removeprefix("<class '").partition(".")[0] in KNOWN_PACKAGES
