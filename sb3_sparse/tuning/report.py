"""An HTML page on searches, and a CSV of their trials."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sb3_sparse.errors import ConfigError, command
from sb3_sparse.files import write_csv, written_whole
from sb3_sparse.pages import html
from sb3_sparse.pages.plot import svg_of
from sb3_sparse.tuning.backend import BaseStorage, TrialState, optuna, quiet_optuna
from sb3_sparse.tuning.figures import pictures
from sb3_sparse.tuning.search import Search, folder_name
from sb3_sparse.tuning.storage import FOLDER, JOURNAL, open_existing
from sb3_sparse.tuning.tables import best_by_method, best_trials
from sb3_sparse.tuning.urls import shown_url
from sb3_sparse.tuning.words import facts, outcome

LOGS = Path("logs")


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
    return _write([Search(study) for study in studies], storage, path, [])


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
    options = ["--storage", shown_url(storage)] if storage else []
    options += ["--log-folder", str(log_folder)] if log_folder != LOGS else []
    options += ["--out", str(path)] if path else []
    storage = storage or log_folder / FOLDER / JOURNAL
    opened = open_existing(storage)
    searches = [Search.find(opened, name, shown_url(storage)) for name in names]
    path = path or log_folder / FOLDER / folder_name(names[0]) / "report.html"
    made_by = [html.paragraph("This command draws the page:")]
    made_by.append(html.code(command("tune", "report", *names, *options)))
    return _write(searches, opened, path, made_by)


def _write(
    searches: Sequence[Search], storage: BaseStorage, path: Path, made_by: Sequence[str]
) -> Path:
    for search in searches:
        if not search.status().complete:
            raise ConfigError(
                f"no trial of {search.name!r} was completed yet, so there is nothing to report"
            )
    compared, unread = best_by_method(searches, storage)
    methods = [html.section("Best of each method", *compared)] if compared else []
    outcomes, trials = [outcome(search) for search in searches], path.with_suffix(".csv")
    if len(searches) == 1:
        (about,) = map(_about, searches)
        sections = [*(html.section(title, *content) for title, content in about), *methods]
    else:
        sections = [*methods, *map(_together, searches)]
    end = [*_facts(searches), *map(html.paragraph, unread)]
    end += [html.paragraph("Every trial:", html.link(trials.name, trials.name)), *made_by]
    sections.append(html.section("Details", *end))
    title = "Tuning: " + ", ".join(search.name for search in searches)
    page = html.page(title, map(html.lead, outcomes), sections)
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as new:
        new.write_text(page, encoding="utf-8")
    _write_trials(searches, trials)
    return path


def _about(search: Search) -> list[tuple[str, list[str]]]:
    """Return what the page shows of a search: a table and figures, with their titles."""
    drawn, missing = [], []
    for one in pictures(search):
        if one.figure is None:
            missing.append(html.paragraph(one.caption))
        else:
            image = html.image(svg_of(one.figure), f"{one.title}: {one.caption}")
            drawn.append(
                html.figure(f"{one.name}-{search.name}", one.title, image, one.caption, [])
            )
    return [best_trials(search), ("Figures", [html.row(drawn), *missing])]


def _together(search: Search) -> html.Section:
    (title, table), (_, figures) = _about(search)
    return html.section(search.name, html.subsection(title, *table), *figures)


def _facts(searches: Sequence[Search]) -> list[str]:
    listings = [html.listing(facts(search)) for search in searches]
    if len(searches) == 1:
        return listings
    names = (search.name for search in searches)
    return [html.subsection(*one) for one in zip(names, listings, strict=True)]


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
