"""The one call that exports a trained model."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import nn

from sb3_sparse.analysis.evaluation import check_eval_env
from sb3_sparse.errors import ConfigError, MissingExtra, UnsupportedError
from sb3_sparse.export.artifact import GRAPH_ARTIFACTS, dense_artifact
from sb3_sparse.export.calibrate import integer_graph
from sb3_sparse.export.effect import Returns, play_both
from sb3_sparse.export.extract import check_model, graph_of, span_of
from sb3_sparse.export.failure import failure_of
from sb3_sparse.export.fold import fold
from sb3_sparse.export.formats import check_format, check_int8, check_outputs
from sb3_sparse.export.graph import Graph
from sb3_sparse.export.observations import (
    Observations,
    check_recorded,
    check_spaces,
    check_statistics,
    has_images,
    random_observations,
)
from sb3_sparse.export.parity import Parity, ParityError, compare
from sb3_sparse.export.quantize import quantized
from sb3_sparse.export.reference import predictor, rounded
from sb3_sparse.export.sbx import NOT_CARRIED, as_sb3, is_sbx_model
from sb3_sparse.export.units import remove_dead_units, units_of
from sb3_sparse.loading.statistics import read_statistics
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.saving import was_normalised

RANDOM = 1000
RANDOM_IMAGES = 100


@dataclass(frozen=True)
class ExportReport:
    """The outcome of an export.

    :param files: the files and their sizes in bytes
    :param parity: how closely the export acts as the model; None: not checked
    :param rounding: how much 8-bit numbers change the actions; None: there are none
    :param returns: what they do to the return; None: not played
    :param sizes: bytes needed where the policy runs, by kind (``"flash"``, ``"RAM"``)
    :param notes: what the user must know
    :param nnz: connections of the exported networks that are not 0; for ``"dense"``, of all
        networks
    :param exported_nnz: those left once dead units are removed
    :param dense_bytes: float32 weights and biases of these networks if they were dense; 0 for
        ``"dense"``, as the counts of units
    :param removed_units: number of dead units
    :param units: number of units before

    Example::

        from stable_baselines3 import PPO
        from sb3_sparse.export import export_policy

        model = PPO("SparsePolicy", "CartPole-v1", policy_kwargs=dict(sparsity=0.9))
        print(export_policy(model, "policy", to="numpy"))
    """

    files: dict[Path, int]
    parity: Parity | None
    rounding: Parity | None
    sizes: dict[str, int]
    notes: tuple[str, ...]
    nnz: int
    exported_nnz: int
    dense_bytes: int = 0
    removed_units: int = 0
    units: int = 0
    returns: Returns | None = None

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
            lines.append(f"int8 against float32: {self.rounding}")
        if self.returns is not None:
            lines.append(f"return: {self.returns}")
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])


def export_policy(
    model: BaseAlgorithm,
    path: str | Path,
    to: str = "c",
    *,
    vecnormalize: VecNormalize | str | Path | None = None,
    observations: Observations | None = None,
    int8: bool | str = False,
    with_value: bool = False,
    stochastic: bool = False,
    eval_env: VecEnv | None = None,
    force: bool = False,
) -> ExportReport:
    """Write a model's deterministic policy in another form, and check that it acts the same.

    ``"c"`` writes a C99 file and its header, ``"numpy"`` an .npz file and its loader, ``"onnx"`` an
    ONNX model. These three take a raw observation to an action, including normalisation and
    rescaling, and leave out dead units. ``"dense"`` writes a zip of stock SB3.

    :param model: a model of a supported algorithm, sparse or stock, or of SBX (SB3 in JAX)
    :param path: the file to write; its suffix may be left out
    :param to: ``"c"``, ``"numpy"``, ``"onnx"`` or ``"dense"``
    :param vecnormalize: what normalised the observations, or the file it was saved to; None: the
        VecNormalize of the model's own environment, if there is one
    :param observations: recorded observations for the check, raw, of shape ``(count, *shape)`` as
        the policy sees them (images channels first), or a dict of such; random ones are always used
    :param int8: for C only: ``"weights"`` (or True) stores weights as 8-bit numbers with a scale
        for each row; ``"full"`` also lets linear layers and activations compute with whole numbers
        alone, for processors without a float unit, in ranges twice those of ``observations``. The
        check then compares with the rounded policy, and the report tells how actions change
    :param eval_env: for ``int8``: environments with the model's wrappers, in which the model and
        the exported policy play for the report: at least 20 episodes each, equally many in each
        environment
    :param with_value: not for ``"dense"``: write an estimate of the return, too, as the output
        ``value``. It is V(s) of PPO, A2C and TRPO; of other algorithms Q(s, a) of the action:
        the mean over quantiles of QRDQN, over all critics' quantiles of TQC, else the minimum over
        critics
    :param stochastic: not for ``"dense"``: write the distribution that training samples actions
        from, too: the outputs ``mean`` and ``std`` of Gaussians (before the tanh of SAC, TQC and
        CrossQ), or ``logits``. The output ``action`` stays the deterministic one
    :param force: write the files even if the check fails or cannot run
    :raises ConfigError: for a value that is not allowed
    :raises UnsupportedError: for an algorithm, network or space that cannot be exported, for a
        distribution of an algorithm that has none, or if there is no C compiler for the check
    :raises CorruptStateError: if the file given as ``vecnormalize`` is damaged
    :raises Diverged: if weights are not finite
    :raises ParityError: if the export does not act as the model: if continuous actions differ by
        more than 1e-5, relative to their size above 1 and to the range they are squashed into, or
        if any discrete action differs; or if further outputs differ by more than 1e-5, relative to
        their largest size above 1 for recorded or for random observations, or ``std`` relative to
        its own size
    """
    check_format(to)
    bits = check_int8(int8, to)
    if bits == "full" and observations is None:
        raise ConfigError(
            "int8='full' takes the ranges of its whole numbers from recorded observations; give "
            "observations (record_observations makes them), or on the command line --env ID"
        )
    if eval_env is not None and bits is None:
        raise ConfigError("eval_env shows what int8 does to the return; give int8, too")
    if eval_env is not None:
        check_eval_env(eval_env)
        check_spaces(model, eval_env)
    check_outputs(to, with_value, stochastic, int8)
    given = model
    if is_sbx_model(given):
        model = as_sb3(given, whole=to == "dense" or with_value)
    check_model(model)
    space = model.observation_space
    normalization = normalization_of(given, vecnormalize)
    if observations is not None:
        check_recorded(observations, space)
    if to == "dense":
        artifact = dense_artifact(model, normalization is not None)
        normalization = written = twin = None  # a zip of SB3 does not normalise by itself
        nnz = _connections(model)
        counts = {"nnz": nnz, "exported_nnz": nnz}
        further = {}
    else:
        if normalization is not None:
            check_statistics(space, normalization)
        raw = graph_of(model, normalization, with_value, stochastic)
        exact = remove_dead_units(fold(raw))
        written = integer_graph(exact, observations) if bits == "full" else exact
        artifact = GRAPH_ARTIFACTS[to](written, bits is not None)
        twin = quantized(written) if bits else None
        counts = _counts(raw, exact)
        _, *others = exact.sizes.items()
        further = dict(others)
    path = main_file(Path(path), next(iter(artifact.files)))
    checked = partial(
        compare,
        discrete=not isinstance(model.action_space, spaces.Box),
        span=span_of(model),
        further=further,
    )
    count = RANDOM_IMAGES if has_images(space) else RANDOM
    random = random_observations(space, normalization, count)
    own = predictor(given, normalization, list(further), unwrapped(model.policy))
    notes = list(artifact.notes)
    if to == "dense" and model is not given:
        notes.append(NOT_CARRIED)
    parity = rounding = returns = None
    try:
        actor = artifact.actor()
    except (UnsupportedError, MissingExtra) as error:
        if not force:
            raise
        notes.append(f"written unchecked, as you asked: {error}")
    else:
        parity = checked(own if twin is None else rounded(twin, actor), actor, observations, random)
        if twin is not None:  # whole numbers have the ranges of recorded observations
            met = None if bits == "full" else random
            rounding = checked(own, actor, observations, met)
    if parity is not None and not parity.holds:
        failure = failure_of(parity, written)
        if not force:
            raise ParityError(
                f"the export to {to!r} does not act as the model: {failure}. Nothing was written; "
                "--force (force=True) writes it all the same"
            )
        notes.append(f"written although it does not act as the model, as you asked: {failure}")
    if eval_env is not None and rounding is not None:
        returns = play_both(own, actor, eval_env, space, model.action_space)
    return ExportReport(
        files=artifact.write(path),
        parity=parity,
        rounding=rounding,
        returns=returns,
        sizes=artifact.sizes,
        notes=tuple(notes),
        **counts,
    )


def normalization_of(
    model: BaseAlgorithm, given: VecNormalize | str | Path | None
) -> VecNormalize | None:
    """Return what normalises a model's observations; None if nothing does.

    :raises ConfigError: if the statistics are missing or invalid
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


def _counts(raw: Graph, exact: Graph) -> dict[str, int]:
    """Count what a graph had, and what it has without dead units."""
    return {
        "dense_bytes": sum(4 * (layer.weight.size + layer.bias.size) for layer in raw.layers),
        "nnz": raw.nnz,
        "exported_nnz": exact.nnz,
        "removed_units": units_of(raw) - units_of(exact),
        "units": units_of(raw),
    }


def _connections(model: BaseAlgorithm) -> int:
    """Count the connections that are not 0, without targets and with shared layers once."""
    layers = [
        module
        for name, module in unwrapped(model.policy).named_modules()
        if isinstance(module, (nn.Linear, nn.Conv2d)) and "target" not in name
    ]
    return sum(int(layer.weight.count_nonzero()) for layer in layers)


def main_file(path: Path, suffix: str) -> Path:
    """Return the file that an export writes, or its main one.

    :param path: the file with or without its suffix, or a folder
    :param suffix: suffix of the format
    :raises ConfigError: for another suffix
    """
    if path.is_dir():
        return path / f"policy{suffix}"
    if path.suffix == suffix:
        return path
    if path.suffix:
        raise ConfigError(f"the file must end in {suffix}, got {path}")
    return path.with_suffix(suffix)
