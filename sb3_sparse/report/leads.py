"""What a page says first: the outcome of its study, in a few sentences."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from statistics import fmean, geometric_mean

from sb3_sparse.pages.numbers import counted, counted_between, shorten
from sb3_sparse.report.data import RunData
from sb3_sparse.report.measured import returns_by_sigma, snr_by_network
from sb3_sparse.report.methods import EQUAL, headline, name_of, percent
from sb3_sparse.report.results import Results
from sb3_sparse.report.summary import PLAIN, sentences, task_of
from sb3_sparse.report.verdicts import Verdict


def leads(results: Results, verdicts: Sequence[Verdict]) -> list[str]:
    """Say what a study found.

    :return: the verdict of a study that tests a single finding, then a sentence for each task on
        what was measured; of other studies a sentence for each task on scores
    """
    keys = {one.finding.key for one in verdicts}
    if len(keys) != 1:
        return sentences(results)
    said = MEASURED.get(keys.pop(), sentences)
    return [*map(_verdict_in_words, verdicts), *said(results)]


def _verdict_in_words(verdict: Verdict) -> str:
    """Say in a sentence what became of a finding."""
    text = f"{verdict.finding.text.removesuffix('.')}: {verdict.verdict}"
    if not verdict.shown:
        return f"{text} ({verdict.remark})."
    seeds = counted(verdict.seeds, "seed")
    return f"{text}, {verdict.shown} of the {verdict.finding.unit}; {seeds}."


def _noise(results: Results) -> Iterator[str]:
    """Say for each task what the strongest noise leaves of the returns."""
    for family in results.families():
        for env_id in results.envs(family):
            here = [run for run in _of_task(results, family, env_id) if _ends(run)]
            levels = {run.level for run in here if run.label not in PLAIN}
            if not levels:
                continue
            level = headline(levels)
            texts, counts = [], []
            labels = results.labels(family, level)
            for label in sorted(labels, key=lambda label: label in PLAIN):
                ends = [_ends(run) for run in results.cell(family, env_id, label, level)]
                known = [end for end in ends if end]
                if known:
                    quiet, loud = shorten([fmean(values) for values in zip(*known, strict=True)])
                    texts.append(f"{PLAIN.get(label, name_of(label))} {quiet} and {loud}")
                    counts.append(len(known))
            seeds = counted_between(counts, "seed")
            yield (
                f"{task_of(results, family, env_id)} at {percent(level)}, mean returns without "
                f"noise and with the strongest: {'; '.join(texts)}; {seeds}."
            )


def _snr(results: Results) -> Iterator[str]:
    """Say for each network of each task what its ratio is by sparsity."""
    for family in results.families():
        for env_id in results.envs(family):
            found: dict[str, dict[float, list[float]]] = {}
            for run in _of_task(results, family, env_id):
                for network, points in snr_by_network(run.measured).items():
                    values = [value for _, value in points if value > 0]
                    if values and run.label != EQUAL:
                        by_level = found.setdefault(network, {})
                        by_level.setdefault(run.level, []).append(geometric_mean(values))
            for network, by_level in found.items():
                means = shorten([geometric_mean(by_level[level]) for level in sorted(by_level)])
                levels = ("dense" if not level else percent(level) for level in sorted(by_level))
                texts = (f"{level} {mean}" for level, mean in zip(levels, means, strict=True))
                seeds = counted_between([*map(len, by_level.values())], "seed")
                of = f", {network}" if len(found) > 1 else ""
                yield (
                    f"{task_of(results, family, env_id)}{of}, geometric mean of the ratio over "
                    f"training: {'; '.join(texts)}; {seeds}."
                )


def _of_task(results: Results, family: str, env_id: str) -> list[RunData]:
    return [run for run in results.main if (run.family, run.env_id) == (family, env_id)]


def _ends(run: RunData) -> tuple[float, float] | None:
    """Return the returns without noise and with the strongest; None if a run has not both."""
    by_sigma = returns_by_sigma(run.measured)
    strongest = max(by_sigma, default=0.0)
    return (by_sigma[0.0], by_sigma[strongest]) if strongest and 0.0 in by_sigma else None


MEASURED: dict[str, Callable[[Results], Iterator[str] | list[str]]] = {
    "noise": _noise,
    "snr": _snr,
}
"""What is said of the tasks of a study on a single finding, by its key, unless it is scores."""
