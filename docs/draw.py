"""Draws the numbers and figures of the documents from the archive of runs, results/runs.jsonl.

    python docs/draw.py             # after new runs: rewrites blocks of the documents, and figures
    python docs/draw.py --check     # fails if a block is not what its lines of the archive give

A block stands between ``<!-- drawn: NAME -->`` and ``<!-- end -->``. findings.md says from how many
lines of the archive its blocks are, so that they can be checked while the archive grows.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import fmean, median
from tempfile import TemporaryDirectory

from sb3_sparse.pages.numbers import short
from sb3_sparse.pages.plot import Drawing, styled, svg_of
from sb3_sparse.pages.table import Cell, Table
from sb3_sparse.report import FIGURES, FINDINGS, Results, Verdict, judge, read_runs
from sb3_sparse.report.data import RunData
from sb3_sparse.report.figures.findings import forest
from sb3_sparse.report.methods import DENSE, EQUAL, name_of, percent
from sb3_sparse.report.summary import scores, sentences
from sb3_sparse.studies import Study, status_of
from sb3_sparse.studies.cost import Costs
from sb3_sparse.studies.status import CellStatus
from sb3_sparse.zoo.archive import Archive

DOCS = Path(__file__).parent
ARCHIVE = DOCS / "results/runs.jsonl"
NOWHERE = DOCS / "results/runs"  # a store without runs: the archive alone counts
DOCUMENTS = (DOCS / "findings.md", DOCS.parent / "README.md")
BLOCK = re.compile(r"(<!-- drawn: ([^>]*?) -->\n).*?(<!-- end -->)", re.DOTALL)
LINES = re.compile(r"first ([\d,]+) lines of the archive")

COMPARED = (
    ("classic_control", "medium"),
    ("classic_control", "small"),
    ("ppo", "medium"),
    ("ppo", "small"),
    ("sac", "medium"),
)
STUDIES: dict[str, tuple[tuple[str, str], ...]] = {
    "equal-parameters": COMPARED,
    "no-loss": COMPARED,
    "rigl-set": COMPARED,
    "erk": (("distribution", "medium"), ("distribution", "small")),
    "critic": (("actor_critic", "small"),),
    "weight-decay": (("weight_decay", "medium"), ("weight_decay", "small")),
    "snr": (("snr", "medium"), ("snr", "small")),
    "noise": (("noise", "medium"), ("noise", "small")),
}
"""The studies that test each finding; of two with the same tasks, the first is drawn."""
PUBLISHED = {
    "DQN on classic control": 100_000,
    "PPO on MuJoCo": 1_000_000,
    "SAC on MuJoCo": 1_000_000,
}
"""Environment steps of the paper's runs."""


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
        lines = {one.folder.path: one.archived for one in self.statuses if one.archived}
        runs, _ = read_runs([], lines)
        return Results(tuple(runs), self.study.varies)

    @cached_property
    def verdicts(self) -> list[Verdict]:
        """The verdicts on all findings."""
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
            "scores": self._scores,
            "width": self._width,
            "comparison": self._comparison,
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
        """One row a finding: its verdict by the study with the most published steps."""
        yield "| the paper's finding | verdict | effect [95 % interval] | holds for | seeds | by |"
        yield "| --- | --- | --- | --- | --- | --- |"
        for finding in FINDINGS:
            known = [(one, shown) for one, shown in self._judged(finding.key)]
            link = f"[{finding.text.removesuffix('.')}](#{finding.key})"
            if not known:
                yield f"| {link} | no runs yet | | | | |"
            for one, shown in known:
                effect = f"{_number(one.effect)} {_ends(one)}" if one.effect is not None else ""
                by = f"{one.family}, {shown.steps:,} steps"
                verdict = f"**{one.verdict}**" if one.verdict != "not enough data" else one.verdict
                yield f"| {link} | {verdict} | {effect} | {one.holds} | {one.seeds or ''} | {by} |"

    def _judged(self, key: str) -> list[tuple[Verdict, Shown]]:
        """Return the verdicts on a finding that have an effect, one for each family of tasks."""
        found: dict[str, tuple[Verdict, Shown]] = {}
        for where in STUDIES[key]:
            shown = self.shown(*where)
            for one in shown.verdicts:
                if one.finding.key == key and one.effect is not None:
                    found.setdefault(one.family, (one, shown))
        return list(found.values())

    def _finding(self, key: str) -> Iterator[str]:
        for where in STUDIES[key]:
            shown = self.shown(*where)
            tested = [one for one in shown.verdicts if one.finding.key == key and one.family]
            said = "; ".join(_said(one) for one in tested) or "no runs yet"
            published = all(PUBLISHED.get(one.family) == shown.steps for one in tested)
            steps = f"{shown.steps:,} steps" + (", as published" if tested and published else "")
            yield f"- {shown.name}, {steps}: {said}.{self._missing(shown)}"
        drawn = self._judged(key)
        if not drawn:
            return
        self.figures[f"finding-{key}"] = lambda: _forest(drawn, key)
        (text,) = (one.text for one in FINDINGS if one.key == key)
        yield ""
        yield f"![{text} Effects with 95 % intervals.](figures/finding-{key}.svg)"

    def _missing(self, shown: Shown) -> str:
        if not shown.pending:
            return ""
        return f" Missing: {self._costs.left(shown.pending)}."

    def _comparison(self, name: str, scale: str, figure: str) -> Iterator[str]:
        """Sentences and one figure, for the README."""
        results = self.shown(name, scale).results
        for text in sentences(results):
            yield f"- {text}"
        yield ""
        yield self._picture(name, scale, figure, "docs/figures")

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
        self.figures[file] = lambda: _draw(figure, shown.results)
        return f"![{FIGURES[figure].title}: {shown.study.title}.]({folder}/{file}.svg)"

    def _width(self, name: str, scale: str) -> Iterator[str]:
        """Return by parameters and by seconds: sparse wide against dense narrow networks."""
        results = self.shown(name, scale).results
        heads = ["task", "network", "parameters", "return", "seconds of training"]
        rows = []
        for family in results.families():
            for env_id in results.envs(family):
                for label, level, runs in _networks(results, family, env_id):
                    seconds = [run.seconds for run in runs if run.seconds is not None]
                    rows.append(
                        [
                            env_id,
                            name_of(label) if label == DENSE else f"{name_of(label)}, {level}",
                            round(fmean(run.parameters for run in runs)),
                            f"{short(fmean(run.score for run in runs), 3)} ({len(runs)})",
                            short(median(seconds), 2) if seconds else None,
                        ]
                    )
        yield from _markdown(Table(heads, rows))


def _networks(
    results: Results, family: str, env_id: str
) -> Iterator[tuple[str, str, list[RunData]]]:
    for label in results.labels(family):
        for level in [0.0] if label == DENSE else results.levels(family):
            runs = results.cell(family, env_id, label, level)
            if runs and (label in (DENSE, EQUAL, "static", "set", "rigl")):
                yield label, percent(level), runs


def _said(one: Verdict) -> str:
    if one.effect is None:
        return f"{one.family}: not enough data ({one.remark})"
    text = f"{one.family}: **{one.verdict}**, {_number(one.effect)} {_ends(one)}"
    text += f" of the {one.finding.unit}, n = {one.seeds} seeds in each of {one.strata} comparisons"
    text += f" (holds for {one.holds})" if one.holds else ""
    if one.verdict == "not enough data" and one.needed:
        text += f"; {one.needed} seeds would decide it if the effect stays"
    return text


def _ends(one: Verdict) -> str:
    assert one.low is not None
    assert one.high is not None
    return f"[{_number(one.low)}; {_number(one.high)}]"


def _number(value: float) -> str:
    return f"{value:+.2f}"


def _markdown(table: Table) -> Iterator[str]:
    yield f"| {' | '.join(table.heads)} |"
    yield f"|{' --- |' * len(table.heads)}"
    for row in table.rows:
        yield f"| {' | '.join(map(_text, row))} |"


def _text(entry: object) -> str:
    if isinstance(entry, Cell):
        return f"**{entry.text}**" if entry.strong else entry.text
    return "" if entry is None else f"{entry:,}" if isinstance(entry, int) else str(entry)


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


def _draw(name: str, results: Results) -> Drawing:
    with styled():
        return FIGURES[name].draw(results)


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
    for name, draw in drawn.figures.items():
        (folder / f"{name}.svg").write_bytes(svg_of(draw().figure))
    for old in set(folder.glob("*.svg")) - {folder / f"{name}.svg" for name in drawn.figures}:
        old.unlink()
    print(f"{len(drawn.figures)} figures and the blocks of {len(new)} documents are drawn")
    return 0


if __name__ == "__main__":
    sys.exit(main())
