"""A compression from a model to a folder."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_sparse.compress.evaluation import check_eval_env
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
"""Batches from this number on decide nothing."""


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
    """Make a trained model as sparse as its return allows, or as sparse as asked for.

    Pruned is the network that acts: the actor, or the Q network. A critic keeps what it has, since
    nobody deploys it and fine-tuning needs it. Level by level 40 % of the remaining connections go,
    those of least magnitude, and the model is fine-tuned with what is left.

    With ``max_drop``, a level passes when the 95 % confidence interval of the change in mean return
    lies above ``-max_drop * |mean return|`` and fails when it lies below. As long as it is
    undecided, another batch of episodes is played, up to 8; then it has failed. After the first
    failure the gap is halved twice. Looking several times at one level, and choosing among levels,
    makes false passes somewhat likelier than the 2.5 % of a single look; the returns of the outcome
    are therefore measured once more, on fresh episodes.

    Everything is kept in ``folder``: the same call goes on with an interrupted compression at the
    first level that is not done, and returns the outcome of a finished one. Given the same seed, an
    on-policy model comes out the same whether it was interrupted or not; an off-policy one may
    not, since its replay buffer is filled anew.

    :param model: with an environment to fine-tune in; stock or sparse; left as it is, but for its
        environment and replay buffer, which are used. Load it with ``verbose=0`` for quiet
    :param eval_env: environments of the evaluation, with the model's normalisation if it has one
    :param folder: is made; holds ``<name>.zip`` in the end, ``<name>/vecnormalize.pkl`` too if
        there is normalisation, and ``compress.json``
    :param max_drop: largest drop of the mean return, as a share of it, in [0, 1) (0.03)
    :param sparsity: of the acting network, instead: ends at it, with no guard
    :param steps: environment steps of each fine-tuning; None: 5 % of the model's, 10,000 or more
    :param episodes: of a batch, 2 or more
    :param seed: of training and evaluation
    :param deterministic: whether policies are evaluated deterministically
    :param distribution: ``"erk"``, ``"er"`` or ``"uniform"``; None: a sparse model's own, or erk
    :param name: of the final files
    :param say: is told what happens, line by line
    :raises ConfigError: for a value that is not allowed, a model without environment, a return that
        no share can be taken of, or a folder with a compression of other settings
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
    before = pruner.nnz
    rules = Rules(
        start=pruner.sparsities[pruner.network],
        floor=pruner.floor,
        max_drop=settings["max_drop"],
        goal=settings["sparsity"],
        batches=BATCHES if settings["max_drop"] is not None else 1,
    )
    path = folder / f"{name}.zip"
    if rules.goal is not None and rules.goal <= rules.start:
        raise ConfigError(
            f"sparsity={rules.goal} is not above the {rules.start} that the {pruner.network} has "
            "already; give more"
        )
    if rules.goal is not None and 1.0 - rules.goal < rules.floor:
        raise ConfigError(
            f"sparsity={rules.goal} leaves less than one connection a layer of the "
            f"{pruner.network}; allowed is up to {math.floor(1e4 * (1.0 - rules.floor)) / 1e4}"
        )
    if record.finished and not path.is_file():
        raise CorruptStateError(
            f"the compression in {folder} is finished, but {path} is missing; remove the folder "
            "and begin anew"
        )
    if record.finished:
        say(f"The compression in {folder} is finished")
        pruner.clear()
        return _outcome(record, pruner, path, before)
    if record.levels:
        say(f"Going on after level {len(record.levels)}")
    if record.accepted:
        pruner.restore(record.accepted)

    def save() -> None:
        record.save(folder)
        pruner.forget_levels(record.accepted)

    search(rules, pruner, record.baseline, record.levels, save, say)
    pruner.back_to_accepted()
    if record.checked is None:
        record.checked = _check(record, pruner)
        save()
    pruner.finish(name)
    record.finished = True
    save()
    pruner.clear()
    return _outcome(record, pruner, path, before)


def _settings(
    model: BaseAlgorithm,
    eval_env: VecEnv,
    max_drop: float | None,
    sparsity: float | None,
    steps: int | None,
    episodes: int,
    seed: int,
) -> dict[str, Any]:
    """What decides about the outcome, checked."""
    sparsity_of(model)  # is refused if there is no sparse counterpart
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
    """Returns of outcome and baseline on fresh episodes, as many as it was accepted by."""
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
