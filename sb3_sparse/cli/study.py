"""``sb3-sparse study``: list, run, status and report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from sb3_sparse.cli.common import INTERRUPTED, Address, GymPackages, Launcher, console, option, say
from sb3_sparse.cli.progress.study import StudyProgress
from sb3_sparse.errors import ConfigError, MissingExtra, command
from sb3_sparse.launch import launcher_named
from sb3_sparse.studies import Study

if TYPE_CHECKING:
    from sb3_sparse.studies.status import CellStatus
    from sb3_sparse.zoo.archive import Lines

studies = typer.Typer(no_args_is_help=True)
Name = Annotated[str, typer.Argument(help="A name of `study list`, or a file of your own, .yml.")]
Scale = Annotated[
    str,
    option(
        "smoke (minutes), small (a night on a laptop), medium (days, of some studies) or paper "
        "(its seeds and steps)."
    ),
]
Archive = Annotated[
    Path | None,
    option(
        "JSON-lines file of finished cells, to be committed; they count as done.",
        "--archive",
        shown=False,
    ),
]
Store = Annotated[Path, option("Folder of runs and reports, shared by studies.", "--folder", "-f")]


@studies.command("list")
def list_() -> None:
    """List the studies that come with the package."""
    from sb3_sparse.studies.blocks import SCALES, planned_runs, study_names, title_of

    table = Table("study", "what", *SCALES, box=None, header_style="bold")
    for name in study_names():
        runs = planned_runs(name)
        table.add_row(name, title_of(name), *(str(runs.get(scale, "")) for scale in SCALES))
    console.print(table)
    say("Numbers are runs. Start a study with: sb3-sparse study run NAME --scale SCALE")


@studies.command()
def run(
    name: Name,
    scale: Scale = "small",
    workers: Annotated[int, option("Simultaneous runs, each in a process of one thread.")] = 1,
    launcher: Launcher = "local",
    address: Address = None,
    store: Store = Path("studies"),
    archive: Archive = None,
    gym_packages: GymPackages = None,
) -> None:
    """Train the missing runs of a study. Give the same command again to resume it."""
    asked = _Asked(name, scale, store, archive, gym_packages or [])
    chosen = launcher_named(launcher, address)
    study = asked.study()
    from sb3_sparse.studies import run_study  # not for a mistyped name

    if Path(name).suffix:
        _check_page(study)
    _say_merged(study)
    runner = run_study(study, store, chosen, workers, archive)
    shown = StudyProgress(console)
    last = None
    try:
        for last in runner:
            shown(last)
    except KeyboardInterrupt:
        say("Stopping; running cells are kept up to their last checkpoint ...")
        runner.close()
        more = ["--workers", str(workers)] if workers > 1 else []
        say(f"Resume with: {asked.command('run', *more)}")
        raise typer.Exit(INTERRUPTED) from None
    finally:
        shown.close()
    assert last is not None
    if last.elsewhere:
        say(f"{last.elsewhere} runs are being trained by other processes; check again with:")
        say(asked.command("status"))
    alike: dict[str, list[str]] = {}
    for failed, error in last.failed.items():
        alike.setdefault(error.rstrip(), []).append(failed)
    for error, runs in alike.items():
        say(f"\nFailed twice: {'; '.join(runs)}", style="bold")
        say(error)
    say(f"{last.done} of {last.planned} runs are done.")
    if last.diverged:
        say(f"Diverged, and not run again: {last.diverged}; the report names them.")
    if last.done or last.diverged:
        say(f"Report on them with: {asked.command('report')}")
    if last.failed:
        raise typer.Exit(1)


@studies.command()
def status(
    name: Name,
    scale: Scale = "small",
    store: Store = Path("studies"),
    archive: Archive = None,
    gym_packages: GymPackages = None,
) -> None:
    """Show what a study has and lacks, what that costs, and what verdicts need."""
    asked = _Asked(name, scale, store, archive, gym_packages or [])
    study = asked.study()
    from sb3_sparse.cli.missing import costs_of, findings_of
    from sb3_sparse.studies.cost import Costs
    from sb3_sparse.studies.status import CellState, counts

    lines = asked.lines()
    statuses = asked.statuses(study, lines)
    costs = Costs.known(store, lines)
    _say_merged(study)
    found = counts(statuses)
    say(f"{study.title}, scale {scale}: {len(statuses)} runs")
    say(", ".join(f"{number} {what}" for what, number in found.items()))
    for line in costs_of(statuses, costs):
        say(line)
    for one in statuses:
        if one.state in (CellState.RUNNING, CellState.STOPPED):
            say(f"{one.state}: {one.cell.name}, {one.steps} steps")
        if one.state is CellState.DIVERGED:
            say(f"diverged: {one.cell.name}, at step {one.steps}")
        if one.state is CellState.FAILED:
            say(f"failed: {one.cell.name}; {one.why(store)}")
    for line in findings_of(statuses, costs, study.findings, study.references):
        say(line)


@studies.command()
def report(
    name: Name,
    scale: Scale = "small",
    store: Store = Path("studies"),
    archive: Archive = None,
    out: Annotated[
        Path | None, option("Where it is written.", "--out", "-o", shown="<folder>/<name>/<scale>")
    ] = None,
    gym_packages: GymPackages = None,
) -> None:
    """Write figures, tables and verdicts of the finished runs as one HTML page."""
    asked = _Asked(name, scale, store, archive, gym_packages or [])
    study = asked.study()
    from sb3_sparse.report import write_report
    from sb3_sparse.studies.status import readable

    statuses = asked.statuses(study, asked.lines())
    folders, archived = readable(statuses)
    if not folders and not archived:
        where = store if archive is None else f"{store} or {archive}"
        raise ConfigError(
            f"there is no run of this study in {where} yet; start with: {asked.command('run')}"
        )
    page = write_report(
        folders,
        out or store / study.report_folder,
        title=f"{study.title} ({scale})",
        figures=study.figures,
        findings=study.findings,
        varies=study.varies,
        command="\n".join((asked.command("run"), asked.command("report"))),
        archived=archived,
        references=study.references,
        pending=[_pending(one, store) for one in statuses if not one.state.is_over],
    )
    say(f"Written: {page}")


def _say_merged(study: Study) -> None:
    if study.merged:
        names = "; ".join(study.merged)
        say(f"note: listed more than once, but trained once: {names}")


def _check_page(study: Study) -> None:
    """Reject unknown figures and findings before the runs, if the extra for reports is there."""
    try:
        from sb3_sparse.report.figures import check_figures
        from sb3_sparse.report.findings import check_findings
    except MissingExtra:
        return
    check_figures(study.figures)
    check_findings(study.findings or ())


def _pending(one: CellStatus, store: Path) -> str:
    from sb3_sparse.studies.status import CellState

    failed = f": failed, {one.why(store)}" if one.state is CellState.FAILED else ""
    return f"{one.cell.name}{failed}"


@dataclass(frozen=True)
class _Asked:
    """The arguments that the commands of a study share."""

    name: str
    scale: str
    store: Path
    archive: Path | None
    packages: Sequence[str]

    def study(self) -> Study:
        return Study.read(self.name, self.scale, self.packages)

    def lines(self) -> Lines:
        from sb3_sparse.zoo.archive import Archive

        return {} if self.archive is None else Archive(self.archive).read()

    def statuses(self, study: Study, lines: Lines) -> list[CellStatus]:
        from sb3_sparse.studies import status_of

        return [status_of(cell, self.store, lines) for cell in study.cells]

    def command(self, what: str, *more: str) -> str:
        """Return another command with the same arguments."""
        words = ["study", what, self.name, "--scale", self.scale]
        if self.store != Path("studies"):
            words += ["--folder", str(self.store)]
        if self.archive is not None:
            words += ["--archive", str(self.archive)]
        for package in self.packages:
            words += ["--gym-packages", package]
        return command(*words, *more)
