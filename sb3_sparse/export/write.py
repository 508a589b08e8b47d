"""One call from a trained model to a policy that runs elsewhere."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_sparse.errors import ConfigError, MissingExtra, UnsupportedError
from sb3_sparse.export.artifact import (
    Artifact,
    c_artifact,
    dense_artifact,
    numpy_artifact,
    onnx_artifact,
    predictor,
)
from sb3_sparse.export.extract import check_model, graph_of, span_of
from sb3_sparse.export.fold import fold
from sb3_sparse.export.formats import check_format
from sb3_sparse.export.graph import Graph
from sb3_sparse.export.nodes import Argmax
from sb3_sparse.export.observations import (
    Observations,
    check_recorded,
    check_statistics,
    has_images,
    random_observations,
)
from sb3_sparse.export.parity import TOLERANCE, Parity, ParityError, compare
from sb3_sparse.export.quantize import quantized
from sb3_sparse.export.units import remove_dead_units, units_of
from sb3_sparse.loading.statistics import read_statistics
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.saving import was_normalised

RANDOM = 1000
RANDOM_IMAGES = 100


@dataclass(frozen=True)
class ExportReport:
    """What was written.

    :param files: with their sizes in bytes
    :param parity: how far it is from the model; None: not run
    :param rounding: what 8-bit weights change in the actions; None: weights are float32
    :param dense_bytes: float32 weights and biases of the dense network that acts; 0 for
        ``"dense"``, as the counts of units
    :param nnz: connections of the network that acts that are not 0; for ``"dense"``, of all
    :param exported_nnz: those that are left without dead units
    :param removed_units: dead units
    :param units: units before
    :param sizes: bytes that it takes where it runs, by kind (``"flash"``, ``"RAM"``)
    :param notes: what its user must know
    """

    files: dict[Path, int]
    parity: Parity | None
    rounding: Parity | None
    dense_bytes: int
    nnz: int
    exported_nnz: int
    removed_units: int
    units: int
    sizes: dict[str, int]
    notes: tuple[str, ...]

    def __str__(self) -> str:
        lines = [f"{path}: {size:,} bytes" for path, size in self.files.items()]
        lines += [f"{kind}: {size:,} bytes" for kind, size in self.sizes.items()]
        if self.dense_bytes:
            lines.append(f"float32 weights of the dense network: {self.dense_bytes:,} bytes")
            lines.append(
                f"connections: {self.nnz:,}, exported {self.exported_nnz:,}; "
                f"{self.removed_units} of {self.units} units were dead and are left out"
            )
        else:
            lines.append(f"connections that are not 0: {self.nnz:,}")
        lines.append(f"parity: {'not checked' if self.parity is None else self.parity}")
        if self.rounding is not None:
            lines.append(f"8-bit weights against float32: {self.rounding}")
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])


def export_policy(
    model: BaseAlgorithm,
    path: str | Path,
    to: str = "c",
    *,
    vecnormalize: VecNormalize | str | Path | None = None,
    observations: Observations | None = None,
    int8: bool = False,
    force: bool = False,
) -> ExportReport:
    """Write a model's deterministic policy in another form, and check that it acts the same.

    ``"c"``: one C99 file and its header; ``"numpy"``: an .npz and its loader; ``"onnx"``: an ONNX
    model; these three hold everything from a raw observation to the action, normalisation and
    rescaling too, and no dead units. ``"dense"``: a zip of stock SB3.

    :param model: of a supported algorithm, sparse or stock
    :param path: of the file; its suffix may be left out
    :param to: one of the four
    :param vecnormalize: what normalised the observations, or the file it was saved to; None: the
        one in the model's own environment, if there is one
    :param observations: recorded ones to check with, raw, of shape ``(count, *shape)`` as the
        policy sees them (images channels first), or a dict of such; random ones are used besides
    :param int8: C only: weights as 8-bit numbers with a scale for each row. Parity is then with
        the rounded weights, and what rounding changes in the actions is reported
    :param force: write also what fails the check
    :raises ConfigError: for a value that is not allowed
    :raises UnsupportedError: for an algorithm, network or space that cannot be exported, or where
        there is no C compiler to check with
    :raises CorruptStateError: if weights are not finite
    :raises ParityError: if it does not act as the model: continuous actions that differ by more
        than 1e-5, relative to those above 1 and to the range that they are squashed into, or a
        discrete action that differs
    """
    check_format(to)
    if int8 and to != "c":
        raise ConfigError(f"int8 is for to='c' only, got to={to!r}")
    check_model(model)
    normalization, left_out = normalization_of(model, vecnormalize), False
    space = model.observation_space
    if normalization is not None and to == "dense":
        left_out, normalization = True, None  # which happens outside of the zip, as before
    elif normalization is not None:
        check_statistics(space, normalization)
    if observations is not None:
        check_recorded(observations, space)
    random = random_observations(
        space, normalization, RANDOM_IMAGES if has_images(space) else RANDOM
    )
    made_by = version("sb3-sparse")
    raw = small = Graph(())
    if to == "dense":
        artifact = dense_artifact(model, left_out)
        nnz = exported_nnz = _connections(model)
    else:
        raw = graph_of(model, normalization)
        small = remove_dead_units(fold(raw))
        artifact = (
            c_artifact(small, made_by, int8)
            if to == "c"
            else numpy_artifact(small)
            if to == "numpy"
            else onnx_artifact(small, made_by)
        )
        nnz, exported_nnz = raw.nnz, small.nnz
    suffix = next(iter(artifact.files))
    main = _main_file(Path(path), suffix)
    discrete = not isinstance(model.action_space, spaces.Box)
    notes = list(artifact.notes)
    parity = rounding = None
    own = predictor(model, normalization)
    try:
        actor = artifact.actor()
    except (UnsupportedError, MissingExtra) as error:
        if not force:
            raise
        notes.append(f"written unchecked, as asked: {error}")
    else:
        reference = quantized(small).run if int8 else own
        how = (observations, random, discrete, span_of(model))
        parity = compare(reference, actor, *how)
        if int8:
            rounding = compare(own, actor, *how)
        if not parity.holds:
            failure = _failure(parity, small)
            if not force:
                raise ParityError(
                    f"the export to {to!r} does not act as the model: {failure}. Nothing was "
                    "written; --force (force=True) writes it all the same"
                )
            notes.append(f"written though it does not act as the model, as asked: {failure}")
    return ExportReport(
        files=_write(artifact, main),
        parity=parity,
        rounding=rounding,
        dense_bytes=sum(4 * (layer.weight.size + layer.bias.size) for layer in raw.layers),
        nnz=nnz,
        exported_nnz=exported_nnz,
        removed_units=units_of(raw) - units_of(small),
        units=units_of(raw),
        sizes=artifact.sizes,
        notes=tuple(notes),
    )


def normalization_of(
    model: BaseAlgorithm, given: VecNormalize | str | Path | None
) -> VecNormalize | None:
    """What normalises a model's observations; None if nothing does.

    :raises ConfigError: if the file has no such thing, or the statistics are missing
    """
    if given is None:
        given = model.get_vec_normalize_env()
        if given is None and was_normalised(model):
            raise ConfigError(
                "the model was trained under a VecNormalize whose statistics are not here; give "
                "what VecNormalize.save wrote as vecnormalize (--vecnormalize FILE), also if it "
                "normalised rewards alone"
            )
    elif isinstance(given, (str, Path)):
        given = read_statistics(Path(given))
    elif not isinstance(given, VecNormalize):
        raise ConfigError(f"vecnormalize must be a VecNormalize or its file, got {given!r}")
    return given if given is not None and given.norm_obs else None


def _connections(model: BaseAlgorithm) -> int:
    """Connections of all layers that are not 0, targets left out and shared layers once."""
    layers = [
        module
        for name, module in unwrapped(model.policy).named_modules()
        if isinstance(module, (nn.Linear, nn.Conv2d)) and "target" not in name
    ]
    return sum(int(layer.weight.count_nonzero()) for layer in layers)


def _main_file(path: Path, suffix: str) -> Path:
    if path.is_dir():
        return path / f"policy{suffix}"
    if path.suffix == suffix:
        return path
    if path.suffix:
        raise ConfigError(f"the file must end in {suffix}, got {path}")
    return path.with_suffix(suffix)


def _failure(parity: Parity, graph: Graph) -> str:
    """What is wrong, and by how little, where a tie is what is wrong."""
    text = f"{parity} (allowed: {'0' if parity.discrete else TOLERANCE})"
    if not graph.nodes or not isinstance(graph.nodes[-1], Argmax):
        return text
    assert parity.worst is not None
    scores = graph.values(parity.worst)[-2][:, 0]
    parts = np.split(scores, np.cumsum(graph.nodes[-1].sizes)[:-1])
    gap = min(float(np.diff(np.sort(part)[-2:])[0]) for part in parts if part.size > 1)
    return f"{text}; at one of them the two best actions are {gap:.1e} apart in score"


def _write(artifact: Artifact, main: Path) -> dict[Path, int]:
    """Write all files, or none."""
    main.parent.mkdir(parents=True, exist_ok=True)
    paths = {
        main.with_suffix(name) if name.startswith(".") else main.parent / name: content
        for name, content in artifact.files.items()
    }
    with tempfile.TemporaryDirectory(dir=main.parent, prefix=".export_") as folder:
        for path, content in paths.items():
            if path.is_dir():
                raise ConfigError(f"{path} is a folder and cannot be written; give another name")
            (Path(folder) / path.name).write_bytes(content)
        for path in paths:
            (Path(folder) / path.name).replace(path)
    return {path: len(content) for path, content in paths.items()}
