"""A search in words: its outcome in a sentence, and how it was made."""

from __future__ import annotations

from sb3_sparse.intervals import mean_interval
from sb3_sparse.pages.names import METHODS
from sb3_sparse.pages.numbers import counted, short
from sb3_sparse.tuning.backend import BaseDistribution, FrozenTrial
from sb3_sparse.tuning.definition import Definition
from sb3_sparse.tuning.objective import VALUES
from sb3_sparse.tuning.search import Search, SearchStatus
from sb3_sparse.tuning.spaces import (
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
    with_values,
)
from sb3_sparse.tuning.values import best_of, choices_of, score_of, spelled, value_text, varied
from sb3_sparse.zoo.configs import DENSE

DIGITS = 3  # of scores, in the sentence that opens the page and in its tables


def outcome(search: Search) -> str:
    """Say in a sentence what the best trial of a search reached, and with what.

    Where a trial had the values of the config itself, the sentence compares its score.
    """
    definition, status, best = search.definition, search.status(), best_of(search)
    run = definition.run
    own = next((one for one in status.complete if _is_as_configured(definition, one)), best)
    trials = f"best of {len(status.done):,} trials" if len(status.done) > 1 else "only trial"
    text = (
        f"{what(definition, best)} on {run.env_id} ({run.algo.upper()}, "
        f"{run.settings()['n_timesteps']:,} steps): the {trials} scores {score_in_words(best)}"
    )
    if values := in_words(search, best):
        text += f", with {values}"
    if own.number != best.number:
        same = score_in_words(own) == score_in_words(best)
        scores = "the same" if same else score_in_words(own)
        text += f"; the config as it is, trial {own.number}, scores {scores}"
    elif _is_as_configured(definition, best):
        text += ", as the config has them"
    return f"{text}."


def what(definition: Definition, best: FrozenTrial) -> str:
    """Return method and sparsity; a searched sparsity is that of the best trial."""
    method = definition.method
    if method == DENSE:
        return "Dense training"
    run = with_values(definition.run, best.user_attrs[VALUES])
    sparsity = run.settings().policy_kwargs["sparsity"]
    if isinstance(sparsity, float):
        return f"{METHODS.get(method, method)} at {_percent(sparsity)}"
    shares = ", ".join(f"{name} {_percent(share)}" for name, share in sparsity.items())
    return f"{METHODS.get(method, method)} at {shares}"


def in_words(search: Search, trial: FrozenTrial) -> str:
    """Write the values of a trial, without those that all trials share; none leave no words."""
    fixed = search.definition.space.distributions.keys() - varied(search).keys()
    values = sorted(SearchStatus.values_of(trial).items())
    texts = (f"{spelled(name)} {value_text(value)}" for name, value in values if name not in fixed)
    return ", ".join(texts)


def score_in_words(trial: FrozenTrial) -> str:
    """Write a score, and how far its seeds are apart.

    From three seeds on, that is a 95 % interval; two seeds are named, for such an interval would
    reach 13 standard errors to either side.
    """
    score, seeds = short(score_of(trial), DIGITS), trial.user_attrs.get("scores", [])
    if len(seeds) < 2:
        return score
    if len(seeds) == 2:
        one, other = (short(seed, DIGITS) for seed in seeds)
        return f"{score} (its seeds: {one} and {other})"
    low, high = (short(float(end), DIGITS) for end in mean_interval(seeds)[1:])
    return f"{score} [{low} to {high}]"


def facts(search: Search) -> list[str]:
    """Say how a search was made, and what became of its trials."""
    definition, status = search.definition, search.status()
    run, seeds, evaluation = definition.run, definition.seeds, definition.run.evaluation()
    pruned = len(status.done) - len(status.complete)
    trained = f"seeds {run.seed} to {run.seed + seeds - 1}" if seeds > 1 else f"seed {run.seed}"
    texts = [
        f"Trials: {len(status.complete)} completed, {pruned} pruned, {len(status.failed)} failed, "
        f"of {status.planned} planned. Sampler {definition.sampler}, pruner {definition.pruner}.",
        f"Each trial trains {trained} for {run.settings()['n_timesteps']:,} environment steps, "
        f"evaluated every {evaluation['eval_freq']:,} steps over "
        f"{counted(evaluation['eval_episodes'], 'episode')}. Its score is the mean return of the "
        f"last 10\u00a0% of evaluations{', averaged over the seeds' if seeds > 1 else ''}.",
        *(f"{spelled(name)}: {_range(one)}." for name, one in varied(search).items()),
    ]
    if seeds > 2:
        texts.append("Intervals are Student's t at 95 % over the seeds of one trial.")
    texts.append(
        "The best of many trials owes part of its score to chance. Train its values with other "
        "seeds before you compare them."
    )
    diverged = [one for one in status.done if "diverged" in one.user_attrs]
    texts += [f"Trial {one.number} diverged: {one.user_attrs['diverged']}." for one in diverged]
    texts += [f"Trial {one.number} failed: {status.why_failed(one)}." for one in status.failed]
    return texts


def _is_as_configured(definition: Definition, trial: FrozenTrial) -> bool:
    values = SearchStatus.values_of(trial)
    return with_values(definition.run, values).settings() == definition.run.settings()


def _percent(share: float) -> str:
    return f"{100 * share:.4g} %"


def _range(distribution: BaseDistribution) -> str:
    if isinstance(distribution, CategoricalDistribution):
        return ", ".join(map(value_text, choices_of(distribution)))
    assert isinstance(distribution, (FloatDistribution, IntDistribution))
    ends = f"{value_text(distribution.low)} to {value_text(distribution.high)}"
    return f"{ends}, logarithmic" if distribution.log else ends
