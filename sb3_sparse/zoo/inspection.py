"""Looking into a saved model without running anything that its file says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sb3_sparse.engine.auto import choose
from sb3_sparse.loading.zips import check_state, look_into
from sb3_sparse.policies.report import SPARSE, SparsityReport
from sb3_sparse.policies.storage import KNOWN_PACKAGES
from sb3_sparse.zoo.computing import Computing, computing_in, layers_in
from sb3_sparse.zoo.outline import Outline, outline_of
from sb3_sparse.zoo.positions import image_in
from sb3_sparse.zoo.saved import locate


@dataclass(frozen=True)
class Inspection:
    """What a saved model is.

    :param report: its layers. How each of them computes is that of the run where the run's record
        says it, else as the model was made, on this machine's processor
    :param compute: what it was made with
    :param computing: what the run's record says of how it computed; None: nothing, or no record
    """

    report: SparsityReport
    compute: str
    computing: Computing | None = None

    def __str__(self) -> str:
        return "\n".join([str(self.report), "", *self._remarks()])

    def _remarks(self) -> list[str]:
        if self.computing is not None:
            sittings = [f"Trained {sitting}." for sitting in self.computing.sittings]
            return [f"The run asked for compute={self.computing.asked!r}.", *sittings]
        sparse = sum(layer.compute == SPARSE for layer in self.report.layers)
        if self.compute != "auto":
            return [f"The model was made with compute={self.compute!r}."]
        if sparse:
            of = len(self.report.layers)
            return [f"compute='auto': {sparse} of {of} layers in sparse storage here"]
        return ["compute='auto' keeps masks: no linear layer is large and sparse enough"]


def inspect_model(path: Path, best: bool = False) -> Inspection:
    """The sparsity report of a saved model, and how its layers compute.

    Nothing is unpickled and no class that the file names is imported, so that a stranger's file can
    be looked into.

    :param path: a run's folder, or a zip that SB3 saved, whichever algorithm trained it
    :param best: of a folder, the best policy instead of the last
    :raises ConfigError: if there is no such file, or no sparse policy in it
    :raises CorruptStateError: if the file is damaged, or the run's record
    :raises Diverged: if the network is not finite
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
    """Names of the layers in sparse storage when the model is loaded.

    :param policy_class: what the file says of it
    :param kwargs: the policy's arguments
    """
    names = {layer.name for layer in outline.layers}
    if compute == "sparse":
        return {layer.name for layer in outline.layers if len(layer.shape) == 2}
    if compute != "auto" or not _known(policy_class):
        return set()
    if not _known(kwargs.get("features_extractor_class")):
        names = {name for name in names if "features_extractor." not in name}
    return set(choose(outline.root, outline.layers, names))


def _known(written: object) -> bool:
    """Whether a class, as a file writes it, is one that only calls its layers; None: the usual."""
    module = written.get("__module__") if isinstance(written, dict) else written
    if not isinstance(module, str):
        return True
    return module.removeprefix("<class '").partition(".")[0] in KNOWN_PACKAGES
