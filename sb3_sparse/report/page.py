"""The page of a report, section by section."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sb3_sparse.pages import html
from sb3_sparse.pages.table import Table
from sb3_sparse.report.data import LeftOut
from sb3_sparse.report.figures import FIGURES
from sb3_sparse.report.results import Results
from sb3_sparse.report.tables import verdicts_table
from sb3_sparse.report.verdicts import FINDINGS, LEAST_SEEDS, Verdict

CSV_FILES = ("cells.csv", "runs.csv", "verdicts.csv")
PAPER = "The State of Sparse Training in Deep Reinforcement Learning (arXiv:2206.10369)"
HOW = (
    "Score of a run: mean over the last 10 % of its evaluations. IQM, probability of improvement "
    "and profiles: rliable, 95 % stratified bootstrap over runs with 2,000 resamples (profiles: "
    "1,000) from a fixed seed. rliable needs as many runs of every task: each task gives its "
    "lowest seeds, as many as the scarcest task has. These intervals are rliable's own and too "
    "narrow for few seeds (they cover 75 to 90 % of truths at 3 to 5). Means of one cell: "
    "Student's t; where figures would be all band, the bands are cut at their panel's edge. Where "
    "a cell has runs of several settings, methods are compared by those that change the fewest "
    "settings of their config, then by those with most seeds."
)
INTERVALS = (
    "Effect: difference of the two sides, with a 95 % stratified bootstrap interval, widened for "
    "few seeds (by sqrt(n/(n-1)) and from normal to Student's t): with 3 seeds the plain "
    "bootstrap is much too narrow. Each environment, or environment and sparsity, is a stratum. "
    f"A stratum with fewer than {LEAST_SEEDS} seeds of either side does not count, and without "
    "any there is no verdict. Several findings are tested at 95 % each, with no correction. "
    '"Not enough data" is also the verdict if the interval decides nothing.'
)


@dataclass(frozen=True)
class Shown:
    """A figure of the page.

    :param name: name of the figure
    :param svg: the drawing; None if the figure was left out
    :param remarks: why it was left out, or what is missing in it
    """

    name: str
    svg: bytes | None
    remarks: Sequence[str]


@dataclass(frozen=True)
class Content:
    """The content of the page.

    :param title: heading of the page
    :param results: the runs that are in the report
    :param cells: a row for each family, environment, method, sparsity and variant of settings
    :param verdicts: the verdicts on the findings
    :param figures: the figures, in order
    :param left_out: runs, or files of runs, that are not in the report
    :param pending: cells that are planned and not done
    :param command: the command that continues what is pending; empty if there is none
    """

    title: str
    results: Results
    cells: Table
    verdicts: Sequence[Verdict]
    figures: Sequence[Shown]
    left_out: Sequence[LeftOut]
    pending: Sequence[str]
    command: str

    @property
    def diverged(self) -> list[LeftOut]:
        """The runs whose training ended in NaN."""
        return [one for one in self.left_out if one.diverged]

    @property
    def others(self) -> list[LeftOut]:
        """Everything else that the report leaves out."""
        return [one for one in self.left_out if not one.diverged]


def render(content: Content) -> str:
    """Return the page's HTML."""
    results = content.results
    lead = [html.paragraph(_counts(content)), html.paragraph(f"Findings are those of {PAPER}.")]
    parts = [
        _verdicts(content),
        html.section("Figures", *map(_figure, content.figures)),
        html.section(
            "All cells",
            html.paragraph(
                "IQM and interval over the seeds of one cell, in raw scores. Compared: whether "
                "figures and verdicts that compare methods take these runs."
            ),
            html.table(content.cells),
            html.paragraph("", *(html.link(name, name) for name in CSV_FILES)),
        ),
        _normalisation(results),
        *_diverged(content),
        _left_out(content),
    ]
    if content.pending or content.command:
        parts.append(_pending(content))
    parts.append(_versions(results))
    return html.page(content.title, lead, parts)


def _counts(content: Content) -> str:
    results = content.results
    runs = results.trained
    counted = len(results.runs) - len(runs)
    steps = sum(run.steps for run in runs)
    seeds = len({run.seed for run in runs})
    envs = len({run.env_id for run in results.runs})
    also = f", and {counted} only counted" if counted else ""
    return (
        f"Finished runs: {len(runs)}{also}; seeds: {seeds}; environments: {envs}; environment "
        f"steps: {steps:,}; diverged: {len(content.diverged)}; left out: {len(content.others)}; "
        f"pending: {len(content.pending)}."
    )


def _verdicts(content: Content) -> html.Section:
    rules = [
        f"{one.text} {one.rule}; {one.region.text}. At least {LEAST_SEEDS} seeds of both sides."
        for one in FINDINGS
    ]
    return html.section(
        "Verdicts on the paper's findings",
        html.table(verdicts_table(content.verdicts)),
        html.folded("Rules", html.paragraph(INTERVALS), html.listing(rules)),
    )


def _figure(shown: Shown) -> str:
    entry = FIGURES[shown.name]
    if shown.svg is None:
        why = "; ".join(shown.remarks)
        return html.subsection(entry.title, html.paragraph(f"Left out: {why}."))
    links = (
        html.link(f"figures/{shown.name}.{kind}", kind.upper()) for kind in ("png", "svg", "csv")
    )
    missing = [html.folded("Not in this figure", html.listing(shown.remarks))]
    return html.figure(
        shown.name,
        entry.title,
        html.image(shown.svg, f"{entry.title}: {entry.caption}"),
        entry.caption,
        links,
        *(missing if shown.remarks else ()),
    )


def _normalisation(results: Results) -> html.Section:
    parts = [html.paragraph(HOW)]
    if results.normaliser.scales:
        parts.append(html.listing(results.normaliser.statements()))
    if results.normaliser.missing:
        parts.append(html.paragraph("Without a scale, so in no figure of normalised scores:"))
        parts.append(html.listing(results.normaliser.missing))
    parts.append(
        html.paragraph(
            "Scales: Atari by random play and human testers of Mnih et al. 2015; classic control "
            "from a uniformly random policy, measured with Gymnasium 1.4, to Gymnasium's reward "
            "threshold (Pendulum, which has none: -150); MuJoCo and all else divided by the mean "
            "score of the dense network of full size of the same algorithm."
        )
    )
    return html.section("Scores and normalisation", *parts)


def _diverged(content: Content) -> list[html.Section]:
    if not content.diverged:
        return []
    texts = [f"{one.folder}: {one.reason}" for one in content.diverged]
    warning = (
        "The training of these runs ended in NaN. They have no score, so figures, tables and "
        "verdicts average the other seeds only, which flatters settings that diverge."
    )
    return [html.section("Diverged", html.paragraph(warning), html.listing(texts))]


def _left_out(content: Content) -> html.Section:
    texts = [f"{one.folder}: {one.reason}" for one in content.others]
    parts = [html.listing(texts) if texts else html.paragraph("No run folder was left out.")]
    if content.results.remarks:
        parts += [
            html.paragraph("Cells with runs of several settings:"),
            html.listing(content.results.remarks),
        ]
    return html.section("Left out", *parts)


def _pending(content: Content) -> html.Section:
    parts = [html.paragraph(f"Runs that are planned and not done: {len(content.pending)}.")]
    if content.pending:
        parts.append(html.folded("Which", html.listing(content.pending)))
    if content.command:
        parts += [html.paragraph("This continues it:"), html.code(content.command)]
    return html.section("Pending", *parts)


def _versions(results: Results) -> html.Section:
    found: dict[str, set[str]] = {}
    for run in results.runs:
        versions = run.record.get("versions")
        for name, version in (versions if isinstance(versions, Mapping) else {}).items():
            found.setdefault(str(name), set()).add(str(version))
    texts = [f"{name} {' and '.join(sorted(versions))}" for name, versions in found.items()]
    return html.section("Versions", html.listing(texts or ["none recorded"]))
