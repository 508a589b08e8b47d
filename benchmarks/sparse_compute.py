"""The gain of sparse storage in a layer or a gradient step, beside its rivals.

All variants of a case are timed in turn in one process; the result is the median of the ratios over
the rounds. Rows are appended to a CSV file immediately. Vectors are the default; ``--images``
measures convolutions, and DQN with the Nature CNN and the Impala ResNet, instead.

    python benchmarks/sparse_compute.py                     # layers, and steps 256 and 1024 wide
    python benchmarks/sparse_compute.py --steps --widths 256,512,1024,2048,4096   # hours
    python benchmarks/sparse_compute.py --steps --algos SAC --widths 256 --rounds 41
    python benchmarks/sparse_compute.py --images            # layers, acting and steps on images
    python benchmarks/sparse_compute.py --images --steps --networks nature --threads 2
    python benchmarks/sparse_compute.py --rule              # what the rule of "auto" loses
    python benchmarks/sparse_compute.py --rule --images
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import torch as th
from acting import time_images, time_vectors
from auto_rule import print_rule, time_rule
from compute_rows import FIELDS, line, print_tables, read
from convolutions import LAYERS, time_convolutions
from gradient_steps import ALGOS, EXTRACTORS, Case, of_images, of_vectors, time_steps
from linear_layers import time_layers
from rounds import appending, listed

from sb3_sparse.engine.native.library import in_use, instruction_sets

Rows = Iterator[dict[str, Any]]


def arguments() -> argparse.Namespace:
    """Parse the arguments."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--layers", action="store_true", help="only layers")
    parser.add_argument("--acting", action="store_true", help="only networks on one observation")
    parser.add_argument("--steps", action="store_true", help="only gradient steps")
    parser.add_argument("--rule", action="store_true", help='only what the rule of "auto" loses')
    parser.add_argument("--algos", type=listed(str), default=list(ALGOS))
    parser.add_argument("--widths", type=listed(int))
    parser.add_argument("--images", action="store_true", help="images instead of vectors")
    parser.add_argument(
        "--networks", type=listed(str), default=list(EXTRACTORS), help="of --images: nature,impala"
    )
    parser.add_argument(
        "--distributions",
        type=listed(str),
        default=["erk", "uniform"],
        help="of --images: erk,uniform",
    )
    parser.add_argument(
        "--convolutions", default="", help="of --images: only layers whose name contains this"
    )
    parser.add_argument("--sparsities", type=listed(float))
    parser.add_argument(
        "--activations", type=listed(str), default=["ReLU", "Tanh"], help="of --rule, on vectors"
    )
    parser.add_argument(
        "--instructions", type=listed(str), help="of --rule; default: all there are"
    )
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--csv", type=Path, default=Path("sparse_compute.csv"))
    parser.add_argument("--table", type=Path, help="only print such a CSV file as Markdown")
    args = parser.parse_args()
    for name, known in (("algos", ALGOS), ("networks", EXTRACTORS)):
        unknown = [one for one in getattr(args, name) if one not in known]
        if unknown:
            parser.error(f"--{name}: one of {', '.join(known)}; got {', '.join(unknown)}")
    if not (args.layers or args.acting or args.steps or args.rule):
        args.layers = args.acting = args.steps = True
    args.widths = args.widths or ([32, 64, 128, 256, 512, 1024] if args.rule else [256, 1024])
    if args.sparsities is None:
        low = [0.0, 0.5] if args.images else [0.5]
        args.sparsities = [*(low if args.rule else []), 0.8, 0.9, 0.95, 0.99]
    return args


def image_cases(args: argparse.Namespace) -> list[Case]:
    """The networks for images, with each distribution."""
    return [
        of_images(net).with_sparse(distribution, distribution=distribution)
        for net in args.networks
        for distribution in args.distributions
    ]


def of_images_alone(args: argparse.Namespace, bf16: bool) -> Iterator[Rows]:
    """Yield the parts that ``--images`` measures."""
    cases = image_cases(args)
    if args.layers:
        layers = [layer for layer in LAYERS if args.convolutions in str(layer)]
        yield time_convolutions(layers, args.sparsities, args.rounds, bf16)
    if args.acting:
        yield from (time_images(case, args.sparsities, args.rounds) for case in cases)
    if args.steps:
        yield from (time_steps(case, args.sparsities, args.rounds, bf16) for case in cases)
    if args.rule:
        sets = args.instructions or instruction_sets()
        for case, sparsity in product(cases, args.sparsities):
            yield time_rule(case, sparsity, sets, args.rounds)


def of_vectors_alone(args: argparse.Namespace, bf16: bool) -> Iterator[Rows]:
    """Yield the parts that are measured without ``--images``."""
    if args.layers:
        yield time_layers(args.widths, args.sparsities, args.rounds)
    if args.acting:
        yield time_vectors(args.widths, args.sparsities, args.rounds)
    if args.steps:
        for width, algo in product(args.widths, args.algos):
            yield time_steps(of_vectors(algo, width), args.sparsities, args.rounds, bf16)
    if args.rule:
        sets = args.instructions or instruction_sets()
        grid = product(args.widths, args.algos, args.sparsities, args.activations)
        for width, algo, sparsity, activation in grid:
            yield time_rule(of_vectors(algo, width, activation), sparsity, sets, args.rounds)


def main() -> None:
    args = arguments()
    if args.table is not None:
        rows = read(args.table)
        print_tables(rows)
        if any(row["what"] == "rule" for row in rows):
            print_rule(rows)
        return
    th.set_num_threads(args.threads)
    bf16 = th.backends.mkldnn.is_available() and th.ops.mkldnn._is_mkldnn_bf16_supported()
    print(
        f"torch {th.__version__}, {args.threads} thread(s), {in_use()} kernels, "
        f"bf16 {'yes' if bf16 else 'no'}, median of {args.rounds} interleaved rounds\n"
    )
    threads = f", {args.threads} threads" if args.threads > 1 else ""
    measured = []
    with appending(args.csv, FIELDS) as write:
        for part in (of_images_alone if args.images else of_vectors_alone)(args, bf16):
            for row in part:
                row["case"] += threads
                write(row)
                measured.append(row)
                print(line(row), flush=True)
    if args.rule:
        print_rule(measured)


if __name__ == "__main__":
    main()
