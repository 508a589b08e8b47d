"""The page of a report, section by section."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from sb3_sparse.pages import html
from sb3_sparse.pages.numbers import counted
from sb3_sparse.pages.table import Cell, Table
from sb3_sparse.report.data import LeftOut
from sb3_sparse.report.figures import FIGURES
from sb3_sparse.report.findings import FINDINGS
from sb3_sparse.report.leads import leads
from sb3_sparse.report.methods import percent
from sb3_sparse.report.normalisation import CURE
from sb3_sparse.report.results import Results
from sb3_sparse.report.summary import scores
from sb3_sparse.report.tables import findings_table
from sb3_sparse.report.verdicts import LEAST_SEEDS, Verdict

CSV_FILES = ("cells.csv", "runs.csv", "verdicts.csv")
PAPER = "The State of Sparse Training in Deep Reinforcement Learning (arXiv:2206.10369)"
HOW = (
    "Score of a run: mean over the last 10 % of its evaluations. IQM, probability of improvement "
    "and profiles: rliable, 95 % stratified bootstrap over runs with 2,000 resamples (profiles: "
    "1,000) from a fixed seed. rliable needs as many runs of every task: each task gives its "
    "lowest seeds, as many as the scarcest task has. These intervals are rliable's own and too "
    "narrow for few seeds (they cover 75 to 90 % of truths at 3 to 5). Means of one cell: "
    "Student's t, cut where no return is possible. Where a cell has runs of several settings, "
    "methods are compared by those that change the fewest settings of their config, then by those "
    "with most seeds."
)
INTERVALS = (
    "Effect: difference of the two sides, each pooled over all its runs: the interquartile mean, "
    "for which the best and the worst quarter do not count, or the mean, as the unit says. Where a "
    "side has several methods, their runs of one seed are averaged first. The "
    "interval is a 95 % stratified bootstrap, widened for few seeds (by sqrt(n/(n-1)) and from "
    "normal to Student's t): with 3 seeds the plain bootstrap is much too narrow. A comparison "
    "with fewer than "
    f"{LEAST_SEEDS} seeds of either side does not count, and without any there is no verdict. "
    "Several findings are tested at 95 % each, with no correction. "
    '"Not enough data" is also the verdict if the interval decides nothing; then "seeds needed" '
    "is how many of each side would probably decide it, if the effect stays as it is."
)
UNSCALED = (
    "Tasks without a scale count for no finding but the one on signal-to-noise ratios, and are in "
    "no figure of normalised scores"
)
SCALES = (
    "Scales: by reference_returns, where the study gives them; Atari by random play and human "
    "testers of Mnih et al. 2015; classic control from a uniformly random policy, measured with "
    "Gymnasium 1.4, to Gymnasium's reward threshold (Pendulum, which has none: -150); MuJoCo and "
    "all else divided by the mean score of the dense network of full size of the same algorithm."
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
    :param command: the commands that continue what is pending and make the page; may be empty
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
    """Return the page's HTML: what was found, what shows it, and what it is made of."""
    drawn = [shown for shown in content.figures if shown.svg is not None]
    hero, more = drawn[:1], [shown for shown in content.figures if shown not in drawn[:1]]
    lead = map(html.lead, leads(content.results, content.verdicts))
    sections = [
        *([html.section("Main figure", *map(_figure, hero))] if hero else ()),
        *_scores(content.results),
        _findings(content),
        *([html.section("Figures", *map(_figure, more))] if more else ()),
        _cells(content),
        *_diverged(content),
        _left_out(content),
        _settings(content.results),
        *_pending(content),
    ]
    return html.page(content.title, [*lead, html.paragraph(_counts(content))], sections)


def _counts(content: Content) -> str:
    results = content.results
    runs = results.trained
    untrained = len(results.runs) - len(runs)
    steps = sum(run.steps for run in runs)
    also = f", and {untrained} only counted" if untrained else ""
    without = {
        "diverged": len(content.diverged),
        "left out": len(content.others),
        "still to be trained": len(content.pending),
    }
    missing = "".join(f"; {count} {what}" for what, count in without.items() if count)
    finished = counted(len(runs), "finished run")
    return f"{finished}{also}, {steps:,} environment steps{missing}."


def _scores(results: Results) -> list[html.Section]:
    parts = [
        html.subsection(one.title, html.table(one.table), html.paragraph(one.note))
        for one in scores(results)
    ]
    return [html.section("Scores", *parts)] if parts else []


def _findings(content: Content) -> html.Section:
    tested = [one for one in content.verdicts if one.has_data]
    silent = [one.finding.text for one in content.verdicts if not one.has_data]
    parts = [html.paragraph(f"The findings are those of {PAPER}.")]
    if tested:
        parts += _shortened(findings_table(tested), "verdict")
    missing = content.results.normaliser.missing
    if missing:
        parts += [html.paragraph(f"{UNSCALED}; {CURE}:"), html.listing(missing)]
    if silent:
        scaled = ", or none on a scale," if missing else ""
        parts.append(html.paragraph(f"These runs have no data{scaled} on:"))
        parts.append(html.listing(silent))
    asked = {one.finding.key for one in content.verdicts}
    rules = [
        f"{one.text} {one.rule}; {one.region.text}. At least {LEAST_SEEDS} seeds of both sides."
        for one in FINDINGS
        if one.key in asked
    ]
    folded = html.folded("Rules", html.paragraph(INTERVALS), html.listing(rules))
    return html.section("Findings of the paper", *parts, folded)


def _cells(content: Content) -> html.Section:
    return html.section(
        "All cells",
        html.paragraph(
            "The runs of a cell differ in their seeds alone. IQM with its bootstrap interval, "
            "which is too narrow for few seeds, in raw scores. Compared: whether figures and "
            "verdicts that compare methods take it."
        ),
        *_shortened(_in_percent(content.cells)),
        html.paragraph("", *(html.link(name, name) for name in CSV_FILES)),
    )


def _in_percent(table: Table) -> Table:
    """Show sparsities in percent, in full: two digits would make 100 % of 99.9 %."""
    place = table.heads.index("sparsity")
    rows = [
        [*row[:place], Cell(row[place], percent(row[place])), *row[place + 1 :]]
        for row in table.rows
    ]
    return replace(table, rows=rows)


def _shortened(table: Table, *keep: str) -> list[str]:
    """Make a table without columns of one value, and a sentence of what these hold."""
    shorter, same = table.varying(*keep)
    texts = [f"{name} {value}" for name, value in same.items()]
    return [html.table(shorter), *([html.paragraph(f"All: {', '.join(texts)}.")] if texts else ())]


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


def _settings(results: Results) -> html.Section:
    """Say how runs were trained and scored, and by which versions."""
    parts = [html.listing(_trained(results)), html.paragraph(HOW)]
    if results.normaliser.scales:
        parts.append(html.listing(results.normaliser.statements()))
    parts.append(html.paragraph(SCALES))
    versions = "; ".join(_versions(results)) or "none recorded"
    return html.section("Settings", *parts, html.paragraph(f"Versions: {versions}."))


def _trained(results: Results) -> list[str]:
    """Say of each algorithm and its tasks how long it trained, and how it was evaluated."""
    found: dict[str, dict[str, set[str]]] = {}
    for run in results.trained:
        facts = found.setdefault(run.family, {})
        facts.setdefault("environment steps", set()).add(f"{run.steps:,}")
        facts.setdefault("evaluations", set()).add(str(len(run.returns)))
        facts.setdefault("seeds", set()).add(str(run.seed))
    texts = []
    for family, facts in found.items():
        several = {name: " or ".join(sorted(values, key=len)) for name, values in facts.items()}
        several["seeds"] = f"{len(facts['seeds'])}"
        texts.append(
            f"{family}: " + ", ".join(f"{value} {name}" for name, value in several.items())
        )
    return texts


def _pending(content: Content) -> list[html.Section]:
    if not content.pending and not content.command:
        return []
    parts = []
    if content.pending:
        summary = f"Still to be trained: {counted(len(content.pending), 'run')}"
        parts.append(html.folded(summary, html.listing(content.pending)))
    if content.command:
        parts.append(html.code(content.command))
    return [html.section("Commands", *parts)]


def _versions(results: Results) -> list[str]:
    found: dict[str, set[str]] = {}
    for run in results.runs:
        versions = run.record.get("versions")
        for name, version in (versions if isinstance(versions, Mapping) else {}).items():
            found.setdefault(str(name), set()).add(str(version))
    return [f"{name} {' and '.join(sorted(versions))}" for name, versions in found.items()]
