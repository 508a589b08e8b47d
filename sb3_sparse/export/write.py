"""The one call that exports a trained model."""

from __future__ import annotations

from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_sparse.analysis.evaluation import check_eval_env
from sb3_sparse.errors import ConfigError
from sb3_sparse.export.check import check
from sb3_sparse.export.extract import check_model, graph_of
from sb3_sparse.export.formats import check_format, check_int8, check_outputs
from sb3_sparse.export.observations import (
    Observations,
    check_recorded,
    check_spaces,
    check_statistics,
)
from sb3_sparse.export.report import ExportReport
from sb3_sparse.export.returns import play_both
from sb3_sparse.export.sbx_model import as_sb3, is_sbx_model
from sb3_sparse.export.written import of_graph, of_model
from sb3_sparse.loading.statistics import read_statistics
from sb3_sparse.policies.saving import was_normalised


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
    normalization = normalization_of(given, vecnormalize)
    if observations is not None:
        check_recorded(observations, model.observation_space)
    if to == "dense":
        written = of_model(model, normalization, carried=model is not given)
    else:
        if normalization is not None:
            check_statistics(model.observation_space, normalization)
        raw = graph_of(model, normalization, with_value, stochastic)
        written = of_graph(raw, to, bits, normalization, observations)
    path = main_file(Path(path), next(iter(written.artifact.files)))
    checked = check(written, given, model, observations, force)
    returns = None
    if eval_env is not None and checked.actor is not None:
        space, action_space = model.observation_space, model.action_space
        returns = play_both(checked.own, checked.actor, eval_env, space, action_space)
    return ExportReport(
        files=written.artifact.write(path),
        parity=checked.parity,
        rounding=checked.rounding,
        returns=returns,
        sizes=written.artifact.sizes,
        notes=(*written.artifact.notes, *checked.notes),
        **written.counts,
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
