"""An HTML page on searches: history, importances, slices, the best of each method; and a CSV."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sb3_sparse.errors import ConfigError, MissingExtra, SparsityError
from sb3_sparse.files import write_csv, written_whole
from sb3_sparse.pages import html
from sb3_sparse.pages.table import Table
from sb3_sparse.tuning.backend import BaseStorage, FrozenTrial, TrialState, optuna, quiet_optuna
from sb3_sparse.tuning.definition import Definition
from sb3_sparse.tuning.objective import VALUES
from sb3_sparse.tuning.search import DEFINITION, Search, folder_name
from sb3_sparse.tuning.spaces import with_values
from sb3_sparse.tuning.storage import FOLDER, JOURNAL, open_existing
from sb3_sparse.tuning.urls import shown_url

try:
    import plotly.io
    from optuna.visualization import (
        plot_intermediate_values,
        plot_optimization_history,
        plot_param_importances,
        plot_slice,
    )
except ImportError as error:
    raise MissingExtra("reports on searches", "tune") from error

TOP = 10
HEIGHT = 420
DIGITS = 6
FIGURES: dict[str, Callable[[optuna.Study], Any]] = {
    "Optimization history": plot_optimization_history,
    "Parameter importances": plot_param_importances,
    "Slices": plot_slice,
    "Evaluations while training": plot_intermediate_values,
}


@quiet_optuna()
def write_report(studies: Sequence[optuna.Study], storage: BaseStorage, path: Path) -> Path:
    """Write a page that opens without a network, and beside it a CSV of all trials.

    :param studies: Optuna's studies of the searches, e.g. :attr:`Tuned.study`
    :param storage: where other searches for the same algorithm and environment are looked up, for
        the table of the best of each method
    :param path: path of the page; the CSV has its name with ``.csv``
    :return: the page
    :raises ConfigError: if a search has no completed trial
    """
    searches = [Search(study) for study in studies]
    for search in searches:
        if not search.status().complete:
            raise ConfigError(
                f"no trial of {search.name!r} was completed yet, so there is nothing to report"
            )
    title = "Tuning: " + ", ".join(search.name for search in searches)
    parts = [_best_by_method(searches, storage), *map(_about, searches)]
    page = html.page(title, [], parts, script=plotly.offline.get_plotlyjs())
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as new:
        new.write_text(page, encoding="utf-8")
    _write_trials(searches, path.with_suffix(".csv"))
    return path


@quiet_optuna()
def report_by_name(
    names: Sequence[str], storage: str | Path | None, log_folder: Path, path: Path | None
) -> Path:
    """Write the page on searches, given by their names.

    :param storage: as in :func:`tune`
    :param path: path of the page; None: ``report.html`` in the first search's folder
    :return: the page
    :raises ConfigError: if a search does not exist, or has no completed trial
    """
    storage = storage or log_folder / FOLDER / JOURNAL
    opened = open_existing(storage)
    studies = [Search.find(opened, name, shown_url(storage)).study for name in names]
    folder = log_folder / FOLDER / folder_name(names[0])
    return write_report(studies, opened, path or folder / "report.html")


def _about(search: Search) -> html.Section:
    definition, status = search.definition, search.status()
    pruned = len(status.done) - len(status.complete)
    run = definition.run
    facts = [
        f"{run.algo.upper()} on {run.env_id}, {_what(definition, status.best)}",
        f"{run.settings()['n_timesteps']} steps, {definition.seeds} seed(s) per trial",
        f"sampler {definition.sampler}, pruner {definition.pruner}",
        f"{len(status.complete)} completed, {pruned} pruned, {len(status.failed)} failed, of "
        f"{status.planned} planned",
    ]
    return html.section(
        search.name,
        html.paragraph(f"{'; '.join(facts)}."),
        html.subsection(f"The {TOP} best trials", _top(status.complete)),
        *(html.subsection(title, *_figure(draw, search.study)) for title, draw in FIGURES.items()),
    )


def _figure(draw: Callable[[optuna.Study], Any], study: optuna.Study) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            figure = draw(study)
        except (ValueError, RuntimeError) as error:
            return [html.paragraph(f"These trials do not give it: {error}")]
    said = [w for w in caught if w.category is UserWarning]
    figure.update_layout(height=HEIGHT, title=None, margin={"t": 30})
    picture = plotly.io.to_html(figure, full_html=False, include_plotlyjs=False)
    return [html.frame(picture), *(html.paragraph(f"Optuna says: {w.message}") for w in said)]


def _what(definition: Definition, best: FrozenTrial | None) -> str:
    """Return method and sparsity; a searched sparsity is that of the best trial."""
    if definition.method == "dense":
        return "dense"
    run = definition.run if best is None else with_values(definition.run, best.user_attrs[VALUES])
    sparsity = run.settings().policy_kwargs["sparsity"]
    share = f"{100 * sparsity:.4g}%" if isinstance(sparsity, float) else str(sparsity)
    return f"{definition.method} at {share}"


def _top(trials: Sequence[FrozenTrial]) -> str:
    best = sorted(trials, key=lambda trial: -trial.values[0])[:TOP]
    names = sorted({name for trial in best for name in trial.params})
    rows = [
        [trial.number, trial.values[0], _scores(trial), *(trial.params.get(n) for n in names)]
        for trial in best
    ]
    return html.table(Table(["trial", "score", "score of each seed", *names], rows, DIGITS))


def _scores(trial: FrozenTrial) -> str:
    return ", ".join(f"{score:.6g}" for score in trial.user_attrs.get("scores", []))


def _best_by_method(searches: Sequence[Search], storage: BaseStorage) -> html.Section:
    tasks = {_task(search.definition) for search in searches}
    rows, unread = [], []
    for summary in storage.get_all_studies():
        if DEFINITION not in summary.user_attrs:
            continue
        search = Search(optuna.load_study(storage=storage, study_name=summary.study_name))
        try:
            definition, status = search.definition, search.status()
        except SparsityError as error:  # e.g. of an environment or method that is missing here
            unread.append(html.paragraph(f"Left out: {summary.study_name}: {error}"))
            continue
        if _task(definition) not in tasks or status.best is None:
            continue
        values = status.best.user_attrs[VALUES]
        row = [*_task(definition), _what(definition, status.best), status.best.values[0]]
        shown = ", ".join(f"{name} {value}" for name, value in values.items())
        row += [shown, f"{len(status.complete)} of {status.planned}", definition.seeds]
        rows.append([*row, search.name])
    heads = ["algorithm", "environment", "steps", "method", "best score", "with", "completed"]
    table = Table([*heads, "seeds per trial", "search"], sorted(rows, key=str), DIGITS)
    return html.section("Best of each method", html.table(table), *unread)


def _task(definition: Definition) -> tuple[str, str, int]:
    run = definition.run
    return run.algo, run.env_id, run.settings()["n_timesteps"]


def _write_trials(searches: Sequence[Search], path: Path) -> None:
    """Write a row for each trial: its state, values, score, the seeds' scores, its seconds."""
    trials = [(search, trial) for search in searches for trial in search.status().all]
    names = sorted({name for _, trial in trials for name in trial.params})
    heads = ["study", "trial", "state", "score", *names, "scores", "evaluations", "seconds"]
    rows = []
    for search, trial in trials:
        value = trial.values[0] if trial.state == TrialState.COMPLETE else None
        params = [trial.params.get(name) for name in names]
        row = [search.name, trial.number, trial.state.name.lower(), value, *params]
        scores = " ".join(f"{score:.6g}" for score in trial.user_attrs.get("scores", []))
        seconds = trial.user_attrs.get("seconds")
        rows.append([*row, scores, len(trial.intermediate_values), seconds])
    write_csv(path, heads, rows)
