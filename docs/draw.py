"""Draws the numbers and figures of the documents from the archive of runs, results/runs.jsonl.

    python docs/draw.py             # after new runs: rewrites blocks of the documents, and figures
    python docs/draw.py --check     # fails if a block is not what its lines of the archive give

A block stands between ``<!-- drawn: NAME -->`` and ``<!-- end -->``. findings.md says from how many
lines of the archive its blocks are, so that they can be checked while the archive grows.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from statistics import fmean, median
from tempfile import TemporaryDirectory

from front import front

from sb3_sparse.pages.numbers import counted_between, short
from sb3_sparse.pages.plot import Drawing, styled, svg_of
from sb3_sparse.pages.table import Cell, Table
from sb3_sparse.report import FIGURES, FINDINGS, Results, Verdict, judge, read_runs
from sb3_sparse.report.data import RunData
from sb3_sparse.report.figures import draw
from sb3_sparse.report.figures.findings import forest
from sb3_sparse.report.findings import UNDECIDED
from sb3_sparse.report.measured import snr_by_network
from sb3_sparse.report.methods import DENSE, name_of, percent
from sb3_sparse.report.statistics import Estimate, mean_difference
from sb3_sparse.report.summary import LEAST, score_of, scores
from sb3_sparse.studies import Study, status_of
from sb3_sparse.studies.cost import Costs
from sb3_sparse.studies.status import CellStatus, readable
from sb3_sparse.zoo.archive import Archive

DOCS = Path(__file__).parent
ARCHIVE = DOCS / "results/runs.jsonl"
NOWHERE = DOCS / "results/runs"  # a store without runs: the archive alone counts
DOCUMENTS = (DOCS / "findings.md", DOCS.parent / "README.md")
BLOCK = re.compile(r"(<!-- drawn: ([^>]*?) -->\n).*?(<!-- end -->)", re.DOTALL)
LINES = re.compile(r"first ([\d,]+) lines of the archive")

STUDIES = (
    ("classic_control", "medium"),
    ("classic_control", "small"),
    ("ppo", "medium"),
    ("ppo", "small"),
    ("sac", "medium"),
    ("sac", "small"),
    ("distribution", "medium"),
    ("distribution", "small"),
    ("actor_critic", "small"),
    ("weight_decay", "medium"),
    ("weight_decay", "small"),
    ("snr", "medium"),
    ("snr", "small"),
    ("noise", "medium"),
    ("noise", "small"),
)
"""The studies that test the findings, and their scales."""
FRONT = ("classic_control", "small")
"""The study of the README's picture."""
PUBLISHED = {
    "DQN on classic control": 100_000,
    "PPO on MuJoCo": 1_000_000,
    "SAC on MuJoCo": 1_000_000,
}
"""Environment steps of the paper's runs."""
MANY = 100
"""Seeds beyond which no number is given."""


@dataclass(frozen=True)
class Shown:
    """A study with what is done of it.

    :param study: the study at one scale
    :param statuses: its cells
    """

    study: Study
    statuses: Sequence[CellStatus]

    @cached_property
    def results(self) -> Results:
        """The finished runs."""
        runs, _ = read_runs(*readable(self.statuses))
        return Results(tuple(runs), self.study.varies, self.study.findings)

    @cached_property
    def verdicts(self) -> list[Verdict]:
        """The verdicts on the findings that the study tests."""
        return judge(self.results)

    @property
    def pending(self) -> list[CellStatus]:
        """The cells that are still to be trained."""
        return [one for one in self.statuses if not one.state.is_over]

    @property
    def steps(self) -> int:
        """The environment steps of a run."""
        return int(self.study.cells[0].run.settings()["n_timesteps"])

    @property
    def name(self) -> str:
        return f"`{self.study.name}` at `{self.study.scale}`"


class Drawn:
    """The blocks and figures of the documents.

    :param archive: JSON-lines file of runs
    :param lines: how many of its first lines count; None for all
    """

    def __init__(self, archive: Path, lines: int | None = None) -> None:
        whole = archive.read_bytes().splitlines(keepends=True)
        self.count = len(whole) if lines is None else lines
        with TemporaryDirectory() as folder:
            first = Path(folder) / archive.name
            first.write_bytes(b"".join(whole[: self.count]))
            self._lines = Archive(first).read()
        self._shown: dict[tuple[str, str], Shown] = {}
        self._costs = Costs.known(NOWHERE, self._lines)
        self.figures: dict[str, Callable[[], Drawing]] = {}

    def block(self, name: str) -> str:
        """Return the text of a block, and note its figures.

        :param name: what it shows, and of what, e.g. ``"finding erk"``
        """
        what, *of = name.split()
        made: dict[str, Callable[..., Iterator[str]]] = {
            "archive": self._archive,
            "verdicts": self._verdicts,
            "finding": self._finding,
            "missing": self._missing,
            "scores": self._scores,
            "width": self._width,
            "front": self._front,
            "snr": self._snr,
        }
        return "\n".join(made[what](*of)).rstrip() + "\n"

    def shown(self, name: str, scale: str) -> Shown:
        """Return a study with what is done of it."""
        if (name, scale) not in self._shown:
            study = Study.read(name, scale)
            statuses = [status_of(cell, NOWHERE, self._lines) for cell in study.cells]
            self._shown[name, scale] = Shown(study, statuses)
        return self._shown[name, scale]

    def _archive(self) -> Iterator[str]:
        yield f"Drawn from the first {self.count:,} lines of the archive."

    def _verdicts(self) -> Iterator[str]:
        """How many findings are decided, and a row for each study that tests them."""
        rows = []
        decided = set()
        for finding in FINDINGS:
            link = f"[{finding.text.removesuffix('.')}](#{finding.key})"
            for one, shown in self._judged(finding.key):
                verdict = one.verdict
                if verdict != UNDECIDED:
                    decided.add(finding.key)
                    verdict = f"**{verdict}**"
                effect = one.shown.replace(" ", "\N{NO-BREAK SPACE}")
                seeds = f"{one.seeds} of {len({cell.run.seed for cell in shown.study.cells})}"
                cells = (link, _where(one, shown), verdict, effect, one.holds, seeds)
                rows.append(f"| {' | '.join(cells)} |")
                link = ""  # said once
            if not self._judged(finding.key):
                begun = any(
                    one.has_data and one.finding.key == finding.key
                    for where in STUDIES
                    for one in self.shown(*where).verdicts
                )
                why = "fewer than three seeds" if begun else "no runs yet"
                rows.append(f"| {link} | | {why} | | | |")
        yield (
            f"**Decided so far: {len(decided)} of {len(FINDINGS)} findings.** An effect without a "
            "verdict says where it may lie, and no more."
        )
        yield ""
        yield "| the paper's finding | by | verdict | effect [95 % interval] | holds for | seeds |"
        yield "| --- | --- | --- | ---: | --- | ---: |"
        yield from rows

    def _judged(self, key: str) -> list[tuple[Verdict, Shown]]:
        """Return the verdicts on a finding that have an effect, study by study."""
        return [
            (one, shown)
            for where in STUDIES
            for shown in [self.shown(*where)]
            for one in shown.verdicts
            if one.finding.key == key and one.effect is not None
        ]

    def _finding(self, key: str) -> Iterator[str]:
        drawn = self._judged(key)
        for one, shown in drawn:
            published = " (as published)" if PUBLISHED.get(one.family) == shown.steps else ""
            yield f"- {_where(one, shown)}{published}: {_said(one)}"
        if drawn:
            fullest = _fullest(drawn)
            self.figures[f"finding-{key}"] = lambda: _forest(fullest, key)
            (text,) = (one.text for one in FINDINGS if one.key == key)
            yield ""
            yield f"![{text} Effects with 95 % intervals.](figures/finding-{key}.svg)"
            yield ""
            yield f"Shown: {', '.join(_where(one, shown) for one, shown in fullest)}."
        else:
            yield "No study has three seeds of both sides yet."

    def _missing(self) -> Iterator[str]:
        """What each study lacks, and what that costs."""
        yield "| study | tests | still to be trained |"
        yield "| --- | --- | --- |"
        for where in STUDIES:
            shown = self.shown(*where)
            if shown.pending:
                links = ", ".join(f"[{key}](#{key})" for key in shown.study.findings or ())
                yield f"| {shown.name} | {links} | {self._costs.left(shown.pending)} |"

    def _snr(self, name: str, scale: str) -> Iterator[str]:
        """The ratio by sparsity, as a multiple of the dense network's."""
        results = self.shown(name, scale).results
        levels = sorted({run.level for run in results.main if run.level})
        yield f"| task | {' | '.join(percent(level) for level in levels)} |"
        yield f"| --- |{' --- |' * len(levels)}"
        seeds: set[int] = set()
        for env_id in sorted({run.env_id for run in results.main}):
            logs = {
                level: [
                    fmean(math.log(ratio) for _, ratio in points)
                    for run in results.main
                    if (run.env_id, run.level) == (env_id, level)
                    for points in snr_by_network(run.measured).values()
                ]
                for level in (0.0, *levels)
            }
            seeds |= {len(values) for values in logs.values()}
            found = [mean_difference(logs[level], logs[0.0]) for level in levels]
            texts = [" ".join(_multiple(one)) for one in found]
            yield f"| {env_id} | {' | '.join(texts)} |"
        yield ""
        yield f"95 % Student t (Welch) intervals of the mean logarithm, {min(seeds)} seeds."

    def _front(self) -> Iterator[str]:
        """The picture of the README: speed, and return against parameters."""
        shown = self.shown(*FRONT)
        self.figures["front"] = lambda: front(shown.results)
        runs = Counter((run.env_id, run.label, run.level) for run in shown.results.main)
        seeds = counted_between(runs.values(), "seed")
        yield "![learn() against SB3 and SBX; return against parameters](docs/figures/front.svg)"
        yield ""
        yield (
            f"Left: measured with [this command](#how-it-compares). Right: DQN, {shown.steps:,} "
            f"steps, {seeds}; [what they show](docs/findings.md), with intervals."
        )

    def _scores(self, name: str, scale: str, figure: str) -> Iterator[str]:
        shown = self.shown(name, scale)
        for one in scores(shown.results):
            yield f"**{one.title}**, {shown.steps:,} steps"
            yield ""
            yield from _markdown(one.table)
            yield ""
            yield one.note
            yield ""
        yield self._picture(name, scale, figure, "figures")

    def _picture(self, name: str, scale: str, figure: str, folder: str) -> str:
        shown = self.shown(name, scale)
        file = f"{name}-{scale}-{figure}"
        self.figures[file] = lambda: draw(figure, shown.results)
        return f"![{FIGURES[figure].title}: {shown.study.title}.]({folder}/{file}.svg)"

    def _width(self, name: str, scale: str) -> Iterator[str]:
        """Return by parameters and by seconds: sparse wide against dense narrow networks."""
        results = self.shown(name, scale).results
        heads = ["task", "network", "parameters", "return", "seconds of training"]
        rows = []
        for family in results.families():
            levels = results.levels(family)
            for env_id in results.envs(family):
                for label, level in product(results.labels(family), (0.0, *levels)):
                    runs = results.cell(family, env_id, label, level)
                    if runs and (level == 0.0) == (label == DENSE):
                        network = name_of(label)
                        network += "" if label == DENSE else f", {percent(level)}"
                        parameters = round(fmean(run.parameters for run in runs))
                        rows.append([env_id, network, parameters, _returns(runs), _seconds(runs)])
        yield from _markdown(Table(heads, rows))


def _multiple(one: Estimate) -> tuple[str, str]:
    return f"{math.exp(one.value):.2f}", f"[{math.exp(one.low):.2f}; {math.exp(one.high):.2f}]"


def _returns(runs: Sequence[RunData]) -> str:
    """Return the mean with its interval and the number of seeds, or the returns of one or two."""
    if len(runs) < LEAST:
        return ", ".join(short(run.score, 3) for run in runs)
    one = score_of(runs, runs[0].env_id)
    return f"{short(one.value, 3)} [{short(one.low, 3)}; {short(one.high, 3)}] ({one.seeds})"


def _seconds(runs: Sequence[RunData]) -> str:
    """Return the median, the range and the number of the runs that were timed."""
    timed = [run.seconds for run in runs if run.seconds is not None]
    if not timed:
        return "not timed"
    ends = f", {short(min(timed))} to {short(max(timed))}" if len(timed) > 1 else ""
    return f"{short(median(timed))}{ends} ({len(timed)})"


def _said(one: Verdict) -> str:
    text = f"**{one.verdict}**, {one.shown} of the {one.finding.unit}"
    each = f"each of {one.comparisons} comparisons" if one.comparisons > 1 else "one comparison"
    text += f", {one.seeds} seeds in {each}; the finding holds for effects {one.holds}."
    if one.verdict == UNDECIDED:
        few = one.needed is not None and one.needed <= MANY
        seeds = f"About {one.needed} seeds" if few else f"More than {MANY} seeds"
        text += f" {seeds} would decide it if the effect stays."
    return text


def _markdown(table: Table) -> Iterator[str]:
    yield f"| {' | '.join(table.heads)} |"
    yield f"|{' --- |' * len(table.heads)}"
    for row in table.rows:
        yield f"| {' | '.join(map(_text, row))} |"


def _text(entry: object) -> str:
    if isinstance(entry, Cell):
        return f"**{entry.text}**" if entry.strong else entry.text
    return "" if entry is None else f"{entry:,}" if isinstance(entry, int) else str(entry)


def _where(one: Verdict, shown: Shown) -> str:
    return f"{one.family} at {shown.steps:,} steps"


def _fullest(drawn: Sequence[tuple[Verdict, Shown]]) -> list[tuple[Verdict, Shown]]:
    """Return a verdict of each algorithm and its tasks: of most seeds, then of most steps."""
    found: dict[str, tuple[Verdict, Shown]] = {}
    for one, shown in sorted(drawn, key=lambda pair: (pair[0].seeds, pair[1].steps)):
        found[one.family] = one, shown
    return [found[family] for family in dict.fromkeys(one.family for one, _ in drawn)]


def _forest(drawn: Sequence[tuple[Verdict, Shown]], key: str) -> Drawing:
    families = {one.family: shown for one, shown in drawn}
    runs = [
        run
        for family, shown in families.items()
        for run in shown.results.runs
        if run.family == family
    ]
    with styled():
        return forest(Results(tuple(runs)), [one for one, _ in drawn], [key])


def main(arguments: Sequence[str] | None = None) -> int:
    """Rewrite the blocks and their figures, or check the blocks."""
    parser = argparse.ArgumentParser(description="Draw what documents show of the archive.")
    parser.add_argument("--check", action="store_true", help="compare, and write nothing")
    asked = parser.parse_args(arguments)
    texts = {path: path.read_text(encoding="utf-8") for path in DOCUMENTS}
    told = LINES.search(texts[DOCUMENTS[0]])
    drawn = Drawn(ARCHIVE, int(told[1].replace(",", "")) if asked.check and told else None)
    new = {
        path: BLOCK.sub(lambda one: f"{one[1]}{drawn.block(one[2])}{one[3]}", text)
        for path, text in texts.items()
    }
    if asked.check:
        behind = [str(path.name) for path, text in texts.items() if new[path] != text]
        if behind:
            print(f"not what the archive gives: {', '.join(behind)}; run python docs/draw.py")
        return bool(behind)
    for path, text in new.items():
        path.write_text(text, encoding="utf-8")
    folder = DOCS / "figures"
    folder.mkdir(exist_ok=True)
    for name, drawing in drawn.figures.items():
        (folder / f"{name}.svg").write_bytes(svg_of(drawing().figure))
    for old in set(folder.glob("*.svg")) - {folder / f"{name}.svg" for name in drawn.figures}:
        old.unlink()
    print(f"{len(drawn.figures)} figures and the blocks of {len(new)} documents are drawn")
    return 0


if __name__ == "__main__":
    sys.exit(main())
