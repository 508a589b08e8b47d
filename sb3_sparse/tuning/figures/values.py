"""Scores by the values of hyperparameters: a line, a heat map, or a slice for each of several."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

import numpy as np

from sb3_sparse.intervals import Array
from sb3_sparse.pages.backend import Axes, MaxNLocator
from sb3_sparse.pages.numbers import shorten
from sb3_sparse.sparsity.numeric import is_number
from sb3_sparse.tuning.backend import BaseDistribution, FrozenTrial
from sb3_sparse.tuning.figures.base import BEST, GREY, MEAN, Picture, panels
from sb3_sparse.tuning.search import Search
from sb3_sparse.tuning.spaces import CategoricalDistribution, FloatDistribution, IntDistribution
from sb3_sparse.tuning.values import best_of, choices_of, score_of, spelled, value_text, varied

ROW, SLICE = 0.42, 2.0  # inches: a row of a heat map, a row of slices
DARK = 0.55  # share of the colours from which on a cell's number is white
DECADES, TICKS = 2, 4  # below so many decades ticks stand between powers of ten, too; most ticks
ROOM = 0.05  # share of a range beyond its ends


def by_value(search: Search) -> Picture:
    """Draw scores by the hyperparameters that vary, as suits the space."""
    names, trials = varied(search), search.status().complete
    if not names:
        text = "No hyperparameter has more than one value."
        return Picture("values", "Scores by value", text, None)
    if search.definition.space.grid is not None and len(names) < 3:
        choices = {
            name: choices_of(one)
            for name, one in names.items()
            if isinstance(one, CategoricalDistribution)
        }
        return (_line if len(names) == 1 else _heat_map)(choices, trials)
    return _slices(names, trials, best_of(search))


def _line(choices: Mapping[str, list[Any]], trials: Sequence[FrozenTrial]) -> Picture:
    """Draw the mean score of each choice, and the score of each seed."""
    ((name, values),) = choices.items()
    figure, (axes,) = panels(1)
    seen, means = [], []
    for place, value in enumerate(values):
        there = _with(trials, {name: value})
        if there:
            seen.append(place)
            means.append(fmean(map(score_of, there)))
        seeds = [score for trial in there for score in trial.user_attrs.get("scores", [])]
        axes.scatter([place] * len(seeds), seeds, s=14, color=GREY)
    line = "-" if all(map(is_number, values)) else ""
    axes.plot(seen, means, color=BEST, marker="o", linestyle=line)
    _at_choices(axes, values)
    axes.set(xlabel=spelled(name), ylabel="score")
    text = "The mean score of each value in colour, and the score of each seed in grey."
    return Picture("values", f"Scores by {spelled(name)}", text, figure)


def _heat_map(choices: Mapping[str, list[Any]], trials: Sequence[FrozenTrial]) -> Picture:
    """Draw the mean score of each cell of a grid."""
    across, down = sorted(choices, key=lambda name: len(choices[name]))
    columns, rows = choices[across], choices[down]
    means: Array = np.full((len(rows), len(columns)), np.nan)
    for place in np.ndindex(means.shape):
        there = _with(trials, {down: rows[place[0]], across: columns[place[1]]})
        if there:
            means[place] = fmean(map(score_of, there))
    figure, (axes,) = panels(1, height=ROW * len(rows) + 0.7)
    axes.imshow(means, cmap="Purples", aspect="auto")
    axes.grid(visible=False)
    axes.set_xticks(range(len(columns)), [_tick(value) for value in columns])
    axes.set_yticks(range(len(rows)), [_tick(value) for value in rows])
    axes.tick_params(length=0)
    axes.set(xlabel=spelled(across), ylabel=spelled(down))
    axes.spines[:].set_visible(False)
    _numbers(axes, means)
    text = "The mean score of each pair of values; the best one in bold."
    if np.isnan(means).any():
        text += " Empty cells have no completed trial."
    return Picture("values", f"Scores by {spelled(down)} and {spelled(across)}", text, figure)


def _numbers(axes: Axes, means: Array) -> None:
    known = np.isfinite(means)
    texts = iter(shorten(means[known].tolist()))
    low, high = float(np.nanmin(means)), float(np.nanmax(means))
    for row, column in np.argwhere(known).tolist():
        value = means[row, column]
        share = (value - low) / (high - low) if high > low else 0.0
        axes.text(
            column, row, next(texts), ha="center", va="center",
            color="white" if share > DARK else "black",
            fontweight="bold" if value == high else "normal",
        )  # fmt: skip


def _slices(
    names: Mapping[str, BaseDistribution], trials: Sequence[FrozenTrial], best: FrozenTrial
) -> Picture:
    """Draw the score of each trial over each hyperparameter, one panel for each of these."""
    figure, axes = panels(len(names), columns=2, height=SLICE)
    for one, (name, distribution) in zip(axes, names.items(), strict=True):
        there = [trial for trial in trials if name in trial.params]  # a function may leave it out
        if isinstance(distribution, CategoricalDistribution):
            choices = choices_of(distribution)
            x = [choices.index(trial.params[name]) for trial in there]
            _means(one, x, there)
            _at_choices(one, choices)
        else:
            assert isinstance(distribution, (FloatDistribution, IntDistribution))
            x = [trial.params[name] for trial in there]
            _over_range(one, distribution)
        one.scatter(x, [score_of(trial) for trial in there], s=14, color=GREY, alpha=0.7, lw=0)
        chosen = [at for at, trial in zip(x, there, strict=True) if trial.number == best.number]
        one.scatter(chosen, [score_of(best)] * len(chosen), s=36, color=BEST, lw=0, zorder=3)
        one.set_xlabel(spelled(name))
    figure.supylabel("score")
    text = "Each dot is a completed trial; the best one in colour."
    if any(isinstance(one, CategoricalDistribution) for one in names.values()):
        text += " Short lines are the means of values that several trials share."
    return Picture("values", "Scores by value", text, figure)


def _means(axes: Axes, x: Sequence[int], trials: Sequence[FrozenTrial]) -> None:
    for place in set(x):
        scores = [score_of(trial) for at, trial in zip(x, trials, strict=True) if at == place]
        if len(scores) > 1:
            axes.hlines(fmean(scores), place - 0.25, place + 0.25, color=MEAN, linewidth=1.6)


def _at_choices(axes: Axes, choices: Sequence[Any]) -> None:
    axes.set_xticks(range(len(choices)), [_tick(choice) for choice in choices])
    axes.set_xlim(-0.5, len(choices) - 0.5)


def _over_range(axes: Axes, distribution: FloatDistribution | IntDistribution) -> None:
    """Show the whole range, also where no trial was."""
    low, high = distribution.low, distribution.high
    if distribution.log:
        axes.set_xscale("log")
        room = (high / low) ** ROOM
        axes.set_xlim(low / room, high * room)
        ticks = _ticks(low, high)
        axes.set_xticks(ticks, [_tick(tick) for tick in ticks])
        axes.set_xticks([], minor=True)
    else:
        room = ROOM * (high - low)
        axes.set_xlim(low - room, high + room)
        axes.xaxis.set_major_locator(MaxNLocator(TICKS, steps=[1, 2, 5, 10]))
        axes.xaxis.set_major_formatter(lambda x, _: _tick(x))


def _tick(value: Any) -> str:
    """Write a value below an axis: whole hundreds from 1000 on as 1k, 2.5k."""
    if is_number(value) and value >= 1000 and value % 100 == 0:
        return f"{value / 1000:g}k"
    return value_text(value)


def _with(trials: Sequence[FrozenTrial], values: Mapping[str, Any]) -> list[FrozenTrial]:
    return [one for one in trials if all(one.params[name] == v for name, v in values.items())]


def _ticks(low: float, high: float) -> list[float]:
    """Return powers of ten between two numbers, and 2 and 5 times these if there are few."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    between = (1,) if math.log10(high / low) >= DECADES else (1, 2, 5)
    ticks = [factor * 10.0**power for power in powers for factor in between]
    inside = [tick for tick in ticks if low * (1 - 1e-9) <= tick <= high * (1 + 1e-9)]
    return inside[:: -(-len(inside) // TICKS)] or [low, high]
