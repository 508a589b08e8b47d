"""The picture of the README: speed, and return against parameters."""

from __future__ import annotations

import csv
from pathlib import Path
from statistics import fmean

from sb3_sparse.pages.backend import Axes
from sb3_sparse.pages.lines import RUN, dots, logarithmic
from sb3_sparse.pages.numbers import short
from sb3_sparse.pages.plot import Drawing, Sheet, styled
from sb3_sparse.report import Results
from sb3_sparse.report.methods import DENSE, EQUAL, look_of, name_of

SPEED = Path(__file__).parent / "results/end_to_end.csv"
CASES = (
    ("SAC 256, 90 %", "sac-256", "0.9"),
    ("SAC 1024, 95 %", "sac-1024", "0.95"),
    ("TD3 256, 90 %", "td3-256", "0.9"),
    ("DQN 512, 90 %", "dqn-512", "0.9"),
    ("PPO 256, 90 %", "ppo-256", "0.9"),
)
"""The bars: their texts, and cases and sparsities of the benchmark."""


def front(results: Results) -> Drawing:
    """Draw bars of speed, and lines of normalised scores over both tasks with a dot a run."""
    with styled():
        sheet = Sheet((), 2, 2, 2.9, width=4.4)
        _speed(sheet.axes[0])
        _returns_by_size(sheet.axes[1], results)
        return sheet.drawing()


def _speed(one: Axes) -> None:
    with SPEED.open(newline="") as file:
        rows = {
            (row["case"], row["sparsity"], row["contender"]): float(row["ratio"])
            for row in csv.DictReader(file)
            if row["ratio"]
        }
    for place, (_, case, sparsity) in enumerate(CASES):
        ours = rows[case, sparsity, "ours"]
        sbx = rows.get((case, "", "sbx"))
        one.barh(place - 0.2, ours, 0.38, color=look_of("rigl").color)
        one.text(ours, place - 0.2, f" {short(ours)}", va="center")
        if sbx is not None:
            one.barh(place + 0.2, sbx, 0.38, color=look_of(EQUAL).color)
            one.text(sbx, place + 0.2, f" SBX {short(sbx)}", va="center")
    one.set_yticks(range(len(CASES)), [text for text, *_ in CASES])
    one.invert_yaxis()
    one.axvline(1.0, color=look_of(DENSE).color, linestyle="--")
    one.margins(x=0.15)
    one.grid(visible=False, axis="y")
    one.set(xlabel="multiples of SB3's speed (dashed)")
    one.set_title("learn() with sb3_sparse, one thread", loc="left", weight="bold")


def _returns_by_size(one: Axes, results: Results) -> None:
    (family,) = results.families()
    for label in (DENSE, EQUAL, "prune", "set", "rigl"):
        look = look_of(label)
        points = []
        for level in [0.0] if label == DENSE else results.levels(family):
            runs = [
                run
                for env_id in results.envs(family)
                for run in results.cell(family, env_id, label, level)
            ]
            values = [score for run in runs if (score := results.normaliser(run)) is not None]
            size = fmean(run.parameters for run in runs)
            dots(one, [size] * len(values), values, look, RUN)
            points.append((size, fmean(values)))
        x, y = zip(*points, strict=True)
        one.plot(
            x, y, color=look.color, marker=look.marker, linestyle=look.line, label=name_of(label)
        )
    one.set(xlabel="active parameters", ylabel="mean normalised return")
    logarithmic(one, "x")
    one.set_title("DQN on CartPole and Acrobot", loc="left", weight="bold")
