"""How a search went, trial by trial, and how its trials did while they trained."""

from __future__ import annotations

import numpy as np

from sb3_sparse.pages.backend import Axes, MaxNLocator
from sb3_sparse.tuning.backend import FrozenTrial, TrialState
from sb3_sparse.tuning.evaluations import curve_of
from sb3_sparse.tuning.figures.base import BEST, GREY, Picture, panels
from sb3_sparse.tuning.objective import planned_evaluations
from sb3_sparse.tuning.search import Search
from sb3_sparse.tuning.values import best_of, score_of

PIXELS = 4000  # evaluations from which on grey lines are pixels, which take less room


def history(search: Search) -> Picture:
    """Draw scores in the order of trials."""
    status = search.status()
    pruned = [trial for trial in status.done if trial.state == TrialState.PRUNED]
    figure, (axes,) = panels(1)
    complete = sorted(status.complete, key=lambda trial: trial.number)
    numbers, scores = [one.number for one in complete], [score_of(one) for one in complete]
    axes.scatter(numbers, scores, s=14, color=GREY)
    last = {one.number: _last(one) for one in pruned if one.intermediate_values}
    if last:
        axes.scatter(list(last), list(last.values()), s=18, color=GREY, marker="x", linewidths=1)
    so_far = np.maximum.accumulate(scores)
    end = max(one.number for one in status.done)
    axes.step([*numbers, end], [*so_far, so_far[-1]], where="post", color=BEST)
    best = best_of(search)
    axes.scatter([best.number], [score_of(best)], s=36, color=BEST, zorder=3)
    _name(axes, best)
    axes.set(xlabel="trial", ylabel="score")
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True, min_n_ticks=1))
    texts = ["The score of each trial, and in colour the best so far."]
    if last:
        texts.append("Crosses are pruned trials, at the return of their last evaluation.")
    return Picture("history", "Scores of all trials", " ".join(texts), figure)


def evaluations(search: Search) -> Picture:
    """Draw returns while training over environment steps."""
    status, run = search.status(), search.definition.run
    planned, every = planned_evaluations(run), run.evaluation()["eval_freq"]
    best = best_of(search)
    figure, (axes,) = panels(1)
    many = len(status.done) * planned > PIXELS
    for trial in status.done:
        returns, chosen = curve_of(trial, planned), trial.number == best.number
        steps = every * np.arange(1, len(returns) + 1)
        if chosen:
            axes.plot(steps, returns, color=BEST, linewidth=2.0, zorder=3)
        else:
            axes.plot(steps, returns, color=GREY, linewidth=0.7, alpha=0.7, rasterized=many)
    _name(axes, best)
    axes.set(xlabel="environment steps", ylabel="mean return")
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.xaxis.set_major_formatter(lambda x, _: f"{x:,.0f}")
    seeds = search.definition.seeds
    what = f"the mean over {seeds} seeds" if seeds > 1 else "one seed"
    stopped = len(status.complete) < len(status.done)
    ends = " Lines that end early are pruned trials." if stopped else ""
    text = f"Each line is a trial, {what}; the best one in colour, all others grey.{ends}"
    return Picture("evaluations", "Evaluations while training", text, figure)


def _last(trial: FrozenTrial) -> float:
    return float(trial.intermediate_values[max(trial.intermediate_values)])


def _name(axes: Axes, best: FrozenTrial) -> None:
    """Write above the panel which trial is in colour."""
    axes.set_title(f"best: trial {best.number}", loc="right", color=BEST, fontweight="bold")
