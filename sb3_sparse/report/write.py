"""Write a report: a page, its figures, and the numbers behind them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from sb3_sparse.errors import ConfigError
from sb3_sparse.files import write_csv, written_whole
from sb3_sparse.pages.plot import save
from sb3_sparse.report.figures import NotEnoughData, check_figures, draw
from sb3_sparse.report.normalisation import References
from sb3_sparse.report.page import CSV_FILES, Content, Shown, render
from sb3_sparse.report.reading import read_runs
from sb3_sparse.report.results import Results
from sb3_sparse.report.tables import cells_table, runs_table, verdicts_table
from sb3_sparse.report.verdicts import judge
from sb3_sparse.zoo.archive import Archived

FOLDER = "figures"


def write_report(
    folders: Iterable[Path | str],
    out: Path | str,
    *,
    title: str,
    figures: Sequence[str],
    findings: Sequence[str] | None = None,
    varies: str | None = None,
    command: str = "",
    pending: Sequence[str] = (),
    archived: Mapping[Path, Archived] | None = None,
    references: References | None = None,
) -> Path:
    """Write a report on run folders and archived runs.

    It makes ``index.html``, which opens from disk without a network, ``cells.csv``, ``runs.csv``,
    ``verdicts.csv``, and ``figures/<name>`` as PNG, SVG and CSV. A figure that cannot be drawn from
    these runs stays as an earlier report in ``out`` drew it, or is left out; the page tells why.
    The same runs give the same bytes.

    :param folders: folders of runs; the page names those that cannot be used
    :param out: folder to write to
    :param title: title of the page
    :param figures: names of the figures, in order
    :param findings: keys of the findings of the paper to judge; None for all that have data
    :param varies: setting that was varied, for the figure ``"sensitivity"``
    :param command: the command that continues what is pending
    :param pending: cells that are planned and not done
    :param archived: runs by the folder that they have or had, as in :func:`read_runs`
    :param references: the returns of a task that become 0 and 1 where scores are normalised, e.g.
        ``{"Maze-v0": (-500.0, -60.0)}``; None: those of known tasks, else the dense runs' mean is 1
    :return: the page
    :raises ConfigError: for an unknown figure, or if ``out`` is not a folder
    """
    check_figures(figures)
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise ConfigError(f"the report goes into a folder, and {out} is a file; give another name")
    runs, left_out = read_runs(folders, archived)
    asked = None if findings is None else tuple(findings)
    results = Results(tuple(runs), varies, asked, references or {})
    found = judge(results)
    out.mkdir(parents=True, exist_ok=True)
    shown = [_figure(name, results, out / FOLDER) for name in dict.fromkeys(figures)]
    cells = cells_table(results)
    tables = (cells, runs_table(results), verdicts_table(found))
    for name, table in zip(CSV_FILES, tables, strict=True):
        write_csv(out / name, table.heads, table.rows, digits=10)
    page = out / "index.html"
    content = Content(title, results, cells, found, shown, left_out, tuple(pending), command)
    with written_whole(page) as new:
        new.write_text(render(content), encoding="utf-8")
    return page


def _figure(name: str, results: Results, folder: Path) -> Shown:
    try:
        drawing = draw(name, results)
    except NotEnoughData as error:
        return _kept(name, folder, str(error))
    save(name, drawing, folder)
    return Shown(name, (folder / f"{name}.svg").read_bytes(), list(drawing.remarks))


def _kept(name: str, folder: Path, why_not: str) -> Shown:
    """Keep the figure of an earlier report, drawn e.g. where the models were; else leave it out."""
    drawn = folder / f"{name}.svg"
    if not drawn.is_file():
        return Shown(name, None, [why_not])
    remark = f"This is the figure of an earlier report. It cannot be drawn now: {why_not}"
    return Shown(name, drawn.read_bytes(), [remark])
