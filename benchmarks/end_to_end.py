"""``learn()`` from end to end: stock SB3, this package, and SBX, which is SB3 in JAX.

This package takes part twice: "ours" is its own algorithms (``from sb3_sparse import SAC``), and
"plug-in" is stock SB3's algorithms with its policy. TRPO is plug-in only.

Each contender has its own process. All share one core and one thread and learn in turn, a few
seconds per round, after the steps at which learning starts and SBX compiles. Seconds are processor
time of the process, so the time that other programs take does not count (their load is printed,
since they use the cache too). Results are medians and ranges of the rates over the rounds. Two
parts of a step are timed where possible: the rollout part, which is everything but ``train()``, and
within it the choice of the action (``predict`` off policy, ``forward`` on policy). Rows are
appended to a CSV file immediately.

A case is ``ALGORITHM-NETWORK`` or ``ALGORITHM-NETWORK@ENVIRONMENT``. The network is the width of
two layers, or ``nature`` or ``impala`` for images: of noise, or of an Atari game in SB3's
``AtariWrapper``, four frames to an observation. Hyperparameters are SB3's defaults, except that
``dqn`` takes a gradient step of 128 samples at every step of the environment; ``dqn4`` takes one of
32 samples at every fourth, which is SB3's default.

    python benchmarks/end_to_end.py                                   # about an hour
    python benchmarks/end_to_end.py --cases sac-256,ppo-64@CartPole-v1 --sparsity 0,0.9,0.95
    python benchmarks/end_to_end.py --cases sac-128 --activation elu --method rigl
    python benchmarks/end_to_end.py --cases dqn4-nature@PongNoFrameskip-v4 --sparsity 0.95
    python benchmarks/end_to_end.py --sbx sbx/bin/python              # SBX too
    python benchmarks/end_to_end.py --grid --csv grid.csv             # never slower? Hours
    python benchmarks/end_to_end.py --table end_to_end.csv            # as Markdown

SBX wants a virtual environment of its own:

    python -m venv sbx && sbx/bin/pip install sbx-rl "gymnasium[mujoco]"
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from end_to_end_cases import CASES, parsed
from learner import ACTIVATIONS, ALGORITHMS, IMAGES, SPARSE, Worker
from rounds import appending, in_turn, listed

SBX = 'python -m venv sbx && sbx/bin/pip install sbx-rl "gymnasium[mujoco]"'
GRID_WIDTHS = (32, 64, 128, 256, 512, 1024)
GRID_SPARSITIES = [0.0, 0.5, 0.8, 0.9, 0.95, 0.99]
FIELDS = [
    *("case", "env", "activation", "sparsity", "contender", "rounds", "steps"),
    *("steps_per_second", "lowest", "highest", "ratio", "ratio_lowest", "ratio_highest"),
    *("rollout_us", "rollout_ratio", "act_us", "act_ratio", "core_share"),
]


def measure(
    plan: tuple[str, str | None, list[float]], workers: dict[str, Worker], args: argparse.Namespace
) -> list[dict[str, Any]]:
    """Make rows of the CSV file: stock, then the plug-in and ours by sparsity, then SBX.

    Ours and SBX are left out where they do not have the case.
    """
    case, activation, sparsities = plan
    algo, net, env = parsed(case)
    rollout = 256 if args.grid else 2048
    shared = dict(algo=algo, net=net, env=env, activation=activation, rollout=rollout)
    stock: dict[str, Any] = {"contender": "stock", "sparsity": ""}
    contenders = [stock]
    contenders += [
        {"contender": kind, "sparsity": sparsity}
        for sparsity in sparsities
        for kind in ("plug-in", "ours")
    ]
    contenders += [{"contender": "sbx", "sparsity": ""}] if "sbx" in workers else []
    asked = {f"{who['contender']} {who['sparsity']}".strip(): who for who in contenders}
    made = set()
    for kind, worker in workers.items():
        specs = {
            key: {**shared, "kind": kind, "sparsity": who["sparsity"], "method": args.method}
            for key, who in asked.items()
            if who["contender"] == kind
        }
        made.update(worker.ask(make=specs))
    rate = rate_of(workers["stock"].ask(learn="stock", steps=10))
    steps = max(10, round(rate * args.seconds))
    found = in_turn(
        {
            key: partial(workers[who["contender"]].ask, learn=key, steps=steps)
            for key, who in asked.items()
            if key in made
        },
        args.rounds,
    )
    common = {"case": case, "env": env, "activation": activation or "", "rounds": args.rounds}
    return [
        {**common, **asked[key], **summary(times, found["stock"])} for key, times in found.items()
    ]


def rate_of(times: dict[str, float]) -> float:
    """Compute steps per second."""
    return times["steps"] / times["seconds"]


def summary(rounds: list[dict[str, float]], stock: list[dict[str, float]]) -> dict[str, Any]:
    """Compute medians and ranges, and medians over the rounds of the ratios to stock."""

    def rollout(times: dict[str, float]) -> float:
        return (times["seconds"] - times["train"]) / times["steps"]

    def act(times: dict[str, float]) -> float:
        return times["act"] / times["steps"]

    rates = [rate_of(times) for times in rounds]
    pairs = list(zip(rounds, stock, strict=True))
    ratios = [rate_of(times) / rate_of(base) for times, base in pairs]
    return {
        "steps": rounds[0]["steps"],
        "steps_per_second": median(rates),
        "lowest": min(rates),
        "highest": max(rates),
        "ratio": median(ratios),
        "ratio_lowest": min(ratios),
        "ratio_highest": max(ratios),
        "rollout_us": 1e6 * median(map(rollout, rounds)),
        "rollout_ratio": median(rollout(times) / rollout(base) for times, base in pairs),
        "act_us": 1e6 * median(map(act, rounds)),
        "act_ratio": median(act(times) / act(base) for times, base in pairs),
        "core_share": median(times["seconds"] / times["elapsed"] for times in rounds),
    }


def kind_of(row: Mapping[str, Any]) -> str:
    """Name the contender of a row, without its method."""
    return str(row["contender"]).partition(",")[0]


def line(row: dict[str, Any]) -> str:
    """Format a row for reading; flag this package where it is slower than stock."""
    name = row["contender"] + (f" {row['sparsity']:.0%}" if row["sparsity"] != "" else "")
    where = f"{row['case']} {row['activation']}"
    flag = "" if row["core_share"] > 0.95 else f"  had {row['core_share']:.0%} of the core"
    if kind_of(row) in SPARSE and row["ratio"] < 1:
        flag += "  SLOWER" if row["ratio_highest"] < 1 else "  slower in the median"
    return (
        f"{where:<22} {row['env']:<15} {name:<11} {row['steps_per_second']:8.1f} steps/s "
        f"({row['lowest']:.1f} to {row['highest']:.1f}), {row['ratio']:.2f} of stock "
        f"({row['ratio_lowest']:.2f} to {row['ratio_highest']:.2f}); rollout "
        f"{row['rollout_us']:.0f} us ({row['rollout_ratio']:.2f}), action {row['act_us']:.0f} us "
        f"({row['act_ratio']:.2f}){flag}"
    )


def table(path: Path) -> None:
    """Print a CSV file as Markdown: a line for each case, sparsity and method.

    It has medians, the file the ranges of the rounds. Parts of a step are those of ours, or of the
    plug-in where ours does not exist, as shares of stock's.
    """
    found: dict[tuple[str, ...], dict[str, dict[str, dict[str, str]]]] = {}
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            key = (row["case"].partition("@")[0], row["env"], row["activation"])
            how = row["contender"].removeprefix(kind_of(row))
            shown = f"{float(row['sparsity']):.0%}{how}" if row["sparsity"] else ""
            found.setdefault(key, {}).setdefault(shown, {})[kind_of(row)] = row

    def rate(row: dict[str, str] | None) -> str:
        steps = float(row["steps_per_second"]) if row else 0.0
        return "" if row is None else f"{steps:,.0f}" if steps >= 100 else f"{steps:.3g}"

    def ratio(row: dict[str, str] | None) -> str:
        return "" if row is None else f"{float(row['ratio']):.2f}"

    print(
        "| case | environment | sparsity | stock, steps/s | SBX | plug-in | ours | SBX / stock "
        "| plug-in / stock | ours / stock | rollout part / stock | action / stock |"
    )
    print("|---" * 3 + "|---:" * 9 + "|")
    for (case, env, activation), by_sparsity in found.items():
        dense = by_sparsity.pop("")
        stock, sbx = dense["stock"], dense.get("sbx")
        for shown, rows in by_sparsity.items():
            plugin, ours = rows.get("plug-in"), rows.get("ours")
            cells = [f"{case} {activation}".strip(), env, shown]
            cells += map(rate, (stock, sbx, plugin, ours))
            cells += [ratio(sbx), ratio(plugin), f"**{ratio(ours)}**" if ours else ""]
            sparse = ours or plugin
            assert sparse is not None
            cells += [f"{float(sparse[f'{part}_ratio']):.2f}" for part in ("rollout", "act")]
            print("| " + " | ".join(cells) + " |")


def check_sbx(parser: argparse.ArgumentParser, python: str) -> None:
    """Exit with a message unless this Python can import SBX and MuJoCo."""
    try:
        tried = subprocess.run(
            [python, "-c", "import sbx, mujoco"], capture_output=True, text=True, check=False
        )
    except OSError as error:
        parser.error(f"--sbx: {python} cannot be run ({error}); make one with: {SBX}")
    if tried.returncode:
        why = (tried.stderr.strip().splitlines() or [f"code {tried.returncode}"])[-1]
        parser.error(f"--sbx: {python} is no Python with SBX ({why}); make one with: {SBX}")


def arguments() -> tuple[argparse.Namespace, list[tuple[str, str | None, list[float]]]]:
    """Parse the arguments; give them and the case, activation and sparsities to measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=listed(str), help=f"default {','.join(CASES)}")
    parser.add_argument("--sparsity", type=listed(float), help="default by case")
    parser.add_argument("--activation", type=listed(str), help="default: SB3's")
    parser.add_argument(
        "--method", choices=["set", "rigl"], help="move masks, every 100 gradient steps"
    )
    parser.add_argument("--sbx", metavar="PYTHON", help=f"made with: {SBX}")
    parser.add_argument("--grid", action="store_true", help="all widths and activations, few steps")
    parser.add_argument("--rounds", type=int, help="default 9; 5 with --grid")
    parser.add_argument("--seconds", type=float, help="of stock a round (default 4; 0.5)")
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()  # else no Linux
    parser.add_argument("--core", type=int, choices=cores, help="default: the last")
    parser.add_argument("--csv", type=Path, default=Path("end_to_end.csv"))
    parser.add_argument("--table", type=Path, help="only print such a CSV file as Markdown")
    args = parser.parse_args()
    if args.table is not None and not args.table.is_file():
        parser.error(f"--table: there is no file {args.table}")
    if args.rounds is None:
        args.rounds = 5 if args.grid else 9
    if args.seconds is None:
        args.seconds = 0.5 if args.grid else 4.0
    if args.rounds < 1 or args.seconds <= 0:
        parser.error("--rounds is 1 or more, and --seconds above 0")
    if args.core is None and cores:
        args.core = max(cores)
    images = [case for case in CASES if case.partition("-")[2] in IMAGES]
    grid = [f"{algo}-{width}" for algo in ALGORITHMS for width in GRID_WIDTHS] + images
    cases = args.cases or (grid if args.grid else list(CASES))
    activations = args.activation or (list(ACTIVATIONS) if args.grid else [None])
    unknown = [name for name in activations if name not in (None, *ACTIVATIONS)]
    if unknown:
        parser.error(f"--activation: one of {', '.join(ACTIVATIONS)}; got {', '.join(unknown)}")
    wrong = [value for value in args.sparsity or () if not 0 <= value < 1]
    if wrong:
        parser.error(f"--sparsity: from 0 to below 1, got {wrong[0]}")
    plan = []
    for case in cases:
        try:
            net = parsed(case)[1]
        except ValueError as error:
            parser.error(str(error))
        sparsities = args.sparsity or (GRID_SPARSITIES if args.grid else CASES.get(case, [0.9]))
        plan += [(case, name, sparsities) for name in ([None] if net in IMAGES else activations)]
    if args.sbx is not None and args.table is None:
        check_sbx(parser, args.sbx)
    return args, plan


def main() -> None:
    args, plan = arguments()
    if args.table is not None:
        table(args.table)
        return
    if args.core is not None:
        os.sched_setaffinity(0, {args.core})  # the workers inherit it
    pythons = dict.fromkeys(("stock", *sorted(SPARSE)), sys.executable)
    if args.sbx is not None:
        pythons["sbx"] = args.sbx
    workers = {kind: Worker(python) for kind, python in pythons.items()}
    ours: list[str] = []
    with appending(args.csv, FIELDS) as write:
        for part in plan:
            for row in measure(part, workers, args):
                if row["contender"] in SPARSE:
                    row["contender"] += f", {args.method}" if args.method else ""
                    ours.append(line(row))
                write(row)
                print(line(row), flush=True)
    for worker in workers.values():
        worker.close()
    slower = [text for text in ours if "slower" in text.lower()]
    print(f"\n{len(slower)} of {len(ours)} slower than stock", *slower, sep="\n")


if __name__ == "__main__":
    main()
