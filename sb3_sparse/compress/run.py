"""Compresses a model into a folder."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_sparse.analysis.evaluation import check_eval_env
from sb3_sparse.compress.guard import change, mean_interval
from sb3_sparse.compress.pruner import ModelPruner
from sb3_sparse.compress.record import CompressionRecord, fingerprint, open_record
from sb3_sparse.compress.result import Compression
from sb3_sparse.compress.search import Rules, search
from sb3_sparse.compress.twin import sparsity_of
from sb3_sparse.errors import ConfigError, CorruptStateError
from sb3_sparse.sparsity.distributions import check_distribution, check_sparsity

MAX_DROP = 0.03
BATCHES = 8
FRESH = 1000
"""Batches from this number on have no part in any decision."""


def compress_model(
    model: BaseAlgorithm,
    eval_env: VecEnv,
    folder: str | Path,
    *,
    max_drop: float | None = None,
    sparsity: float | None = None,
    steps: int | None = None,
    episodes: int = 50,
    seed: int = 0,
    deterministic: bool = True,
    distribution: str | None = None,
    name: str = "model",
    say: Callable[[str], None] = lambda line: None,
) -> Compression:
    """Make a trained model as sparse as its return allows, or as sparse as you ask for.

    Only the network that acts is pruned: the actor or the Q network. A critic stays as it is, since
    it is not deployed and fine-tuning needs it. Each level removes the 40 % of the remaining
    connections that have the smallest magnitude, and fine-tunes the rest.

    With ``max_drop``, a level passes when the 95 % confidence interval of the change in mean return
    lies above ``-max_drop * |mean return|``, and fails when it lies below. While neither holds,
    another batch of episodes is played, up to 8; then the level has failed. After the first failure
    the gap is halved twice. Looking several times at one level, and choosing among levels, makes
    false passes somewhat likelier than the 2.5 % of a single look, so the returns of the outcome
    are measured again on fresh episodes.

    Everything is kept in ``folder``. The same call resumes an interrupted compression at the first
    unfinished level, and returns the outcome of a finished one. With equal seeds, an on-policy
    model comes out the same whether it was interrupted or not; an off-policy one may not, since its
    replay buffer is filled anew.

    :param model: a stock or sparse model with an environment to fine-tune in. It is not changed,
        but its environment and replay buffer are used. Load it with ``verbose=0`` to keep it quiet
    :param eval_env: environments for evaluation, with the model's normalisation if it has one
    :param folder: created if needed; receives ``<name>.zip``, ``<name>/vecnormalize.pkl`` if there
        is normalisation, and ``compress.json``
    :param max_drop: largest drop of the mean return, as a share of it, in [0, 1) (0.03)
    :param sparsity: sparsity of the acting network to end at, instead of ``max_drop``
    :param steps: environment steps of each fine-tuning; None: 5 % of the model's, 10,000 or more
    :param episodes: episodes of a batch, 2 or more
    :param seed: seed of training and evaluation
    :param deterministic: whether policies are evaluated deterministically
    :param distribution: ``"erk"``, ``"er"`` or ``"uniform"``; None: a sparse model's own, or erk
    :param name: name of the final files
    :param say: called with each line of progress
    :raises ConfigError: for a value that is not allowed, a model without environment, a return too
        close to 0 to take a share of, or a folder that holds a compression with other settings
    :raises UnsupportedError: as :func:`~sb3_sparse.compress.twin.sparsify`
    :raises CorruptStateError: if the folder is damaged

    Source: iterative magnitude pruning, arXiv:1506.02626, section 3.
    """
    settings = _settings(model, eval_env, max_drop, sparsity, steps, episodes, seed)
    settings |= {"deterministic": deterministic, "distribution": distribution, "name": name}
    if distribution is not None:
        check_distribution(distribution)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    record = open_record(folder, settings)
    pruner = ModelPruner(
        model, eval_env, folder, settings["steps"], episodes, seed, deterministic, distribution
    )
    nnz_before, rules = pruner.nnz, _rules(pruner, settings)
    path = folder / f"{name}.zip"
    if not record.finished:
        _finish(record, pruner, rules, name, say)
    elif path.is_file():
        say(f"The compression in {folder} is finished")
    else:
        raise CorruptStateError(
            f"the compression in {folder} is finished, but {path} is missing; remove the folder "
            "and start again"
        )
    pruner.clear()
    return _outcome(record, pruner, path, nnz_before)


def _finish(
    record: CompressionRecord,
    pruner: ModelPruner,
    rules: Rules,
    name: str,
    say: Callable[[str], None],
) -> None:
    """Complete a compression, and write the final files."""

    def save() -> None:
        record.save(pruner.folder)
        pruner.forget_levels(record.accepted)

    if record.levels:
        say(f"Resuming after level {len(record.levels)}")
    if record.accepted:
        pruner.restore(record.accepted)
    search(rules, pruner, record.baseline, record.levels, save, say)
    pruner.back_to_accepted()
    if record.checked is None:
        record.checked = _check(record, pruner)
        save()
    pruner.finish(name)
    record.finished = True
    save()


def _rules(pruner: ModelPruner, settings: Mapping[str, Any]) -> Rules:
    """Return the rules of a search.

    :raises ConfigError: if the model cannot be pruned to the sparsity asked for
    """
    rules = Rules(
        start=pruner.sparsities[pruner.network],
        floor=pruner.floor,
        max_drop=settings["max_drop"],
        goal=settings["sparsity"],
        batches=1 if settings["max_drop"] is None else BATCHES,
    )
    if rules.goal is not None and rules.goal <= rules.start:
        raise ConfigError(
            f"sparsity={rules.goal} is not above the {rules.start} that the {pruner.network} has "
            "already; give more"
        )
    if rules.goal is not None and 1.0 - rules.goal < rules.floor:
        raise ConfigError(
            f"sparsity={rules.goal} leaves less than one connection per layer of the "
            f"{pruner.network}; allowed is up to {math.floor(1e4 * (1.0 - rules.floor)) / 1e4}"
        )
    return rules


def _settings(
    model: BaseAlgorithm,
    eval_env: VecEnv,
    max_drop: float | None,
    sparsity: float | None,
    steps: int | None,
    episodes: int,
    seed: int,
) -> dict[str, Any]:
    """Check the arguments that decide about the outcome, and return them."""
    sparsity_of(model)  # raises if the model has no sparse counterpart
    if model.env is None:
        raise ConfigError(
            "the model has no environment to be fine-tuned in; load it with one, or call set_env"
        )
    if max_drop is not None and sparsity is not None:
        raise ConfigError("give either a largest drop or a fixed sparsity, not both")
    if sparsity is None:
        max_drop = MAX_DROP if max_drop is None else max_drop
        if not 0.0 <= max_drop < 1.0:
            raise ConfigError(
                f"max_drop must lie in [0, 1) (it is a share of the mean return), got {max_drop}"
            )
    else:
        check_sparsity(sparsity)
    if steps is None:
        steps = max(10_000, model.num_timesteps // 20)
    if not 0 <= seed < 2**31:
        raise ConfigError(f"the seed must lie in [0, 2^31), got {seed}")
    for what, value, least in (("steps", steps, 1), ("episodes", episodes, 2)):
        if value < least:
            raise ConfigError(f"{what} must be {least} or more, got {value}")
    if not isinstance(eval_env, VecEnv):
        raise ConfigError(
            f"eval_env must be a VecEnv, got {type(eval_env).__name__}; wrap it, e.g. by "
            "make_vec_env"
        )
    check_eval_env(eval_env)
    both = (model.get_vec_normalize_env(), unwrap_vec_normalize(eval_env))
    if len({None if env is None else env.norm_obs for env in both}) > 1:
        raise ConfigError(
            "the environments of training and evaluation must both be normalised by VecNormalize, "
            "or neither, and both with norm_obs or without"
        )
    return {
        "model": fingerprint(model),
        "max_drop": max_drop,
        "sparsity": sparsity,
        "steps": steps,
        "episodes": episodes,
        "seed": seed,
        "n_envs": model.env.num_envs,
        "n_eval_envs": eval_env.num_envs,
    }


def _check(record: CompressionRecord, pruner: ModelPruner) -> tuple[list[float], list[float]]:
    """Return outcome and baseline returns of fresh episodes, as many as accepted the outcome."""
    accepted = record.levels[record.accepted - 1] if record.accepted else None
    wanted = len(accepted.returns) if accepted else pruner.episodes
    outcome: list[float] = []
    baseline: list[float] = []
    batch = FRESH
    while len(outcome) < wanted:
        outcome += pruner.returns(False, batch)
        baseline += pruner.returns(True, batch)
        batch += 1
    return outcome, baseline


def _outcome(
    record: CompressionRecord, pruner: ModelPruner, path: Path, before: int
) -> Compression:
    assert record.checked is not None
    outcome, baseline = record.checked
    level = record.levels[record.accepted - 1] if record.accepted else None
    sparsity = dict(pruner.sparsities)
    if level is not None:
        sparsity[pruner.network] = level.sparsity
    return Compression(
        path=path,
        network=pruner.network,
        sparsity=sparsity,
        nnz_before=before,
        nnz=before if level is None else level.nnz,
        baseline=mean_interval(baseline),
        outcome=mean_interval(outcome),
        change=change(outcome, baseline),
        episodes=len(outcome),
        levels=tuple(record.levels),
    )
