"""The findings of the paper on these runs: effects, pooled and one by one, and where they hold."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sb3_sparse.pages.backend import Axes, MaxNLocator
from sb3_sparse.pages.numbers import short
from sb3_sparse.pages.plot import GREY, Drawing, Sheet
from sb3_sparse.report.figures.base import figure
from sb3_sparse.report.findings import FINDINGS, check_findings
from sb3_sparse.report.methods import name_of
from sb3_sparse.report.results import NotEnoughData, Results
from sb3_sparse.report.statistics import Estimate, mean_difference
from sb3_sparse.report.verdicts import LEAST_SEEDS, Verdict, judge, signed

HEADS = ("finding", "algorithm and tasks", "compared", "effect", "low", "high", "unit", "seeds",
         "seeds of the other side", "verdict")  # fmt: skip
WIDE, ROW, AROUND = 10.5, 0.25, 0.95  # inches: the figure, a row, and what is around the rows
POOLED, SINGLE, HOLDS = "#362682", "#555555", "#DDF0E4"
SPARE, LETTERS, FAR = 0.5, 80, 1e9
REGION = "region"


@dataclass(frozen=True)
class _Line:
    """A row of a panel.

    :param text: what is compared
    :param effect: the difference of the two sides
    :param counts: seeds of both sides
    :param verdict: the verdict, of a pooled effect
    """

    text: str
    effect: Estimate
    counts: tuple[int, int]
    verdict: str = ""


@figure(
    "findings",
    "The paper's findings on these runs",
    "Effects of what a finding compares. Diamonds: pooled over all cells compared, with the "
    "interval that the verdict is from. Circles: each of the cells compared alone, a difference of "
    "means with its 95 % Student t (Welch) interval; hollow, and not pooled, below three seeds of "
    "a side. An arrowhead marks an interval that goes on beyond the edge. Shaded: where the "
    "finding holds. The line marks no effect. At the right: seeds of both sides, effect and "
    "interval.",
)
def draw(results: Results) -> Drawing:
    """Draw each finding on which there are data."""
    return forest(results, judge(results))


def forest(
    results: Results, verdicts: Sequence[Verdict], keys: Sequence[str] | None = None
) -> Drawing:
    """Draw effects and verdicts of findings, a panel for each.

    Call it within :func:`sb3_sparse.pages.plot.styled`.

    :param results: the runs
    :param verdicts: those of :func:`judge` on them
    :param keys: keys of the findings, in order; None for all on which there are data
    :raises ConfigError: for an unknown key
    :raises NotEnoughData: if there are data on none of them
    """
    check_findings(keys or ())
    asked = [finding.key for finding in FINDINGS] if keys is None else keys
    given = {
        key: [one for one in verdicts if one.finding.key == key and one.has_data] for key in asked
    }
    shown = [found for found in given.values() if found]
    if not shown:
        why = "; ".join(dict.fromkeys(one.remark for one in verdicts if one.finding.key in given))
        raise NotEnoughData(f"there are no runs to compare: {why}")
    lines = [_lines(results, found) for found in shown]
    rows = [sum(map(len, blocks)) for blocks in lines]
    sheet = Sheet(HEADS, len(shown), 1, sum(AROUND + ROW * n for n in rows) / len(rows), width=WIDE)
    grid = sheet.axes[0].get_subplotspec()
    if grid is not None:
        grid.get_gridspec().set_height_ratios([n + 0.2 for n in rows])
    for one, found, blocks in zip(sheet.axes, shown, lines, strict=True):
        _panel(one, found, blocks)
        for verdict, block in zip(found, blocks, strict=True):
            sheet.rows += [_row(verdict, line) for line in block]
    return sheet.drawing()


def _lines(results: Results, verdicts: Sequence[Verdict]) -> list[list[_Line]]:
    """Return the rows of each verdict: the pooled effect, and those of the cells compared."""
    blocks = []
    for verdict in verdicts:
        sides = verdict.finding.sides(results, verdict.family)
        block = []
        if verdict.effect is not None and verdict.low is not None and verdict.high is not None:
            pooled = Estimate(verdict.effect, verdict.low, verdict.high, verdict.seeds)
            fit = sides.with_seeds(LEAST_SEEDS)
            counts = (min(map(len, fit.x.values())), min(map(len, fit.y.values())))
            block.append(_Line(verdict.family, pooled, counts, verdict.verdict))
        for name in sides.x:
            x, y = sides.x[name], sides.y[name]
            block.append(_Line(_named(name), mean_difference(x, y), (len(x), len(y))))
        blocks.append(block)
    return blocks


def _panel(one: Axes, verdicts: Sequence[Verdict], blocks: list[list[_Line]]) -> None:
    finding = verdicts[0].finding
    top = 0
    texts: list[str] = []
    asides: list[str] = []
    pooled: list[float] = []
    for verdict, block in zip(verdicts, blocks, strict=True):
        for place, line in enumerate(block, start=top):
            _draw(one, line, place)
            texts.append(line.text)
            asides.append(_aside(line))
        pooled += [x for line in block if line.verdict for x in (line.effect.low, line.effect.high)]
        _shade(one, verdict, top, len(block))
        top += len(block)
    single = [line.effect.value for block in blocks for line in block]
    low, high = min(*single, *pooled, 0.0), max(*single, *pooled, 0.0)
    pad = SPARE * ((high - low) or 1.0)
    one.set_xlim(low - pad, high + pad)
    for place, line in enumerate(line for block in blocks for line in block):
        _mark_cut(one, line, place)
    one.set_ylim(top - 0.4, -0.6)
    one.axvline(0.0, color=GREY, linewidth=1.0, zorder=1.5)
    one.set_yticks(range(top), texts)
    one.tick_params(axis="y", length=0)
    one.grid(visible=False, axis="y")
    one.xaxis.set_major_locator(MaxNLocator(5))
    right = one.secondary_yaxis("right")
    right.set_yticks(range(top), asides)
    right.tick_params(length=0)
    right.spines["right"].set_visible(False)
    lines = [line for block in blocks for line in block]
    for axis in (one.yaxis, right.yaxis):
        for line, tick in zip(lines, axis.get_major_ticks(), strict=True):
            for label in (tick.label1, tick.label2):
                label.set_fontweight("bold" if line.verdict else "normal")
    one.set_xlabel(f"difference of {finding.unit}")
    title = textwrap.fill(finding.text, LETTERS)
    one.set_title(title, loc="left", weight="bold", pad=8, x=0.0)


def _draw(one: Axes, line: _Line, place: int) -> None:
    effect = line.effect
    color = POOLED if line.verdict else SINGLE
    if not math.isnan(effect.low):
        width = 3.0 if line.verdict else 1.3
        one.plot([effect.low, effect.high], [place, place], color=color, linewidth=width)
    counts = min(line.counts) >= LEAST_SEEDS
    one.plot(
        effect.value, place, "D" if line.verdict else "o", color=color,
        markerfacecolor=color if counts else "white", markersize=8 if line.verdict else 5,
    )  # fmt: skip


def _mark_cut(one: Axes, line: _Line, place: int) -> None:
    """Draw an arrowhead where an interval goes on beyond the edge."""
    left, right = one.get_xlim()
    inside = 0.02 * (right - left)
    arrow = {"arrowstyle": "-|>", "color": POOLED if line.verdict else SINGLE}
    if line.effect.low < left:
        one.annotate("", (left, place), (left + inside, place), arrowprops=arrow)
    if line.effect.high > right:
        one.annotate("", (right, place), (right - inside, place), arrowprops=arrow)


def _aside(line: _Line) -> str:
    """Return what stands at the right of a row."""
    x, y = line.counts
    effect = line.effect
    ends = "" if math.isnan(effect.low) else f" [{_text(effect.low)}; {_text(effect.high)}]"
    said = f"  {line.verdict}" if line.verdict else ""
    return f"{x} + {y} seeds  {_text(effect.value)}{ends}{said}"


def _text(number: float) -> str:
    """Write an effect as tables do, and a very large one in two digits."""
    text = signed(number) if abs(number) < 10 else short(number)
    return text.replace("-", "\N{MINUS SIGN}")


def _shade(one: Axes, verdict: Verdict, top: int, rows: int) -> None:
    """Shade the effects for which the finding holds behind the rows of a verdict."""
    region = verdict.region
    if region is None and not verdict.finding.region.relative:
        region = verdict.finding.region
    if region is not None:
        low, high = np.clip((region.low, region.high), -FAR, FAR)
        between = [top - 0.5, top + rows - 0.5]
        one.fill_betweenx(between, low, high, color=HOLDS, linewidth=0, zorder=0.5, gid=REGION)


def _named(cell: str) -> str:
    """Write the method at the end of what is compared as figures do."""
    head, comma, label = cell.replace(" at 0 %", "").rpartition(", ")
    return f"{head}{comma}{name_of(label)}"


def _row(verdict: Verdict, line: _Line) -> list[object]:
    effect = line.effect
    said = line.verdict or None
    ends = [effect.value, effect.low, effect.high]
    what = "all" if line.verdict else line.text
    finding = verdict.finding
    return [finding.key, verdict.family, what, *ends, finding.unit, *line.counts, said]
