"""The gain of sparse storage in a layer or a gradient step, beside its rivals.

All variants of a case are timed in turn in one process; the result is the median of the ratios over
the rounds. Rows are appended to a CSV file immediately.

    python benchmarks/sparse_compute.py                     # layers, and steps 256 and 1024 wide
    python benchmarks/sparse_compute.py --steps --widths 256,512,1024,2048,4096   # hours
    python benchmarks/sparse_compute.py --steps --algos SAC --widths 256 --rounds 41
    python benchmarks/sparse_compute.py --rule              # what the rule of "auto" loses
"""

from __future__ import annotations

import argparse
import copy
import csv
import gc
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import nullcontext
from functools import partial
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from random_env import TORQUES, VECTOR, RandomEnv
from rounds import appending, interleaved, listed
from stable_baselines3 import DQN, PPO, SAC, TD3
from step_overhead import fused_like_stock, off_policy, on_policy
from torch.nn import functional

from sb3_sparse.engine.chains import Chain
from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.native.library import in_use, instruction_sets, use
from sb3_sparse.engine.products import TILE, tiles_of
from sb3_sparse.engine.sequential import chain_up
from sb3_sparse.engine.structure import Structure
from sb3_sparse.sparsity import equivalent_widths

Variant = tuple[Any, Callable[[], None], int]


def rows_of(
    what: str, case: str, batch: int, sparsity: float, times: dict[str, list[float]], count: int
) -> Iterator[dict]:
    """Make a row of the CSV file for each variant; the others are compared to the first.

    :param count: steps in each timing
    """
    base = next(iter(times.values()))
    for name, found in times.items():
        yield {
            "what": what,
            "case": case,
            "batch": batch,
            "sparsity": sparsity,
            "variant": name,
            "milliseconds": 1e3 * median(found) / count,
            "speedup": median(a / b for a, b in zip(base, found, strict=True)),
        }


# --- one layer ----------------------------------------------------------------------------------


def layer_steps(width: int, batch: int, sparsity: float) -> dict[str, Callable[[], Any]]:
    """Time forward and backward passes of a square layer with ReLU, dense and sparse."""
    random = np.random.default_rng(0)
    nnz = round(width * width * (1 - sparsity))
    flat = np.sort(random.choice(width * width, nnz, replace=False))
    dense, twin = th.nn.Linear(width, width), th.nn.Linear(width, width)
    x = th.randn(batch, width, requires_grad=True)
    grad = th.randn(batch, width)
    layer = SparseLinear.convert(twin, Structure(flat, (width, width)), is_target=False)
    chain = Chain([layer], [th.nn.ReLU()])
    tiles = th.randn(tiles_of(batch), width, TILE, requires_grad=True)
    tiles_grad = th.randn(tiles_of(batch), width, TILE)
    csr = th.zeros(width * width)
    csr[flat] = layer.weight.detach()
    with_csr = csr.view(width, width).to_sparse_csr().requires_grad_(True)
    turned = x.detach().T.contiguous().requires_grad_(True)

    def backward(y: th.Tensor, inputs: list[th.Tensor], grad: th.Tensor) -> None:
        th.autograd.grad(y, inputs, grad)

    def in_bf16() -> None:
        with th.autocast("cpu", dtype=th.bfloat16):
            y = functional.relu(functional.linear(x, dense.weight, dense.bias))
        backward(y, [x, *dense.parameters()], grad.bfloat16())

    return {
        "dense": lambda: backward(
            functional.relu(functional.linear(x, dense.weight, dense.bias)),
            [x, *dense.parameters()],
            grad,
        ),
        "sparse, tiles": lambda: backward(
            chain.run(tiles, batch, True, True), [tiles, *layer.parameters()], tiles_grad
        ),
        "sparse, rows": lambda: backward(chain(x), [x, *layer.parameters()], grad),
        "torch CSR": lambda: backward(
            functional.relu(with_csr @ turned + layer.bias[:, None]),
            [turned, with_csr, layer.bias],
            grad.T.contiguous(),
        ),
        "dense bf16": in_bf16,
    }


def time_single(widths: list[int], sparsities: list[float], rounds: int) -> Iterator[dict]:
    """Time the forward pass of three layers on one observation, as in a rollout."""
    for width in widths:
        dense = th.nn.Sequential(
            *(th.nn.Linear(17, width), th.nn.ReLU()),
            *(th.nn.Linear(width, width), th.nn.ReLU()),
            th.nn.Linear(width, 6),
        )
        x = th.randn(1, 17)
        for sparsity in sparsities:
            random = np.random.default_rng(0)
            sparse = copy.deepcopy(dense)
            for module in sparse[::2]:
                flat = np.flatnonzero(random.random(module.weight.numel()) >= sparsity)
                shape = tuple(module.weight.shape)
                SparseLinear.convert(module, Structure(flat, shape), is_target=False)
            chain_up(sparse)

            @th.no_grad()
            def by(network: Callable[[th.Tensor], th.Tensor], x=x) -> None:
                for _ in range(200):
                    network(x)

            steps = {"dense": partial(by, dense), "sparse": partial(by, sparse)}
            times = interleaved(steps, rounds)
            yield from rows_of("one", f"17-{width}-{width}-6", 1, sparsity, times, 200)


def time_layers(widths: list[int], sparsities: list[float], rounds: int) -> Iterator[dict]:
    for width in widths:
        for batch in (32, 256):
            for sparsity in sparsities:
                steps = layer_steps(width, batch, sparsity)
                inner = max(5, round(2e8 / (6 * width * width * batch)))
                repeated = {
                    name: (lambda step=step, inner=inner: [step() for _ in range(inner)])
                    for name, step in steps.items()
                }
                times = interleaved(repeated, rounds)
                yield from rows_of("layer", f"{width}x{width}", batch, sparsity, times, inner)


# --- whole gradient steps -----------------------------------------------------------------------

ALGOS = {
    "SAC": (SAC, RandomEnv(VECTOR, TORQUES), 256),
    "TD3": (TD3, RandomEnv(VECTOR, TORQUES), 256),
    "DQN": (DQN, RandomEnv(VECTOR, spaces.Discrete(4)), 128),
    "PPO": (PPO, RandomEnv(VECTOR, TORQUES), 64),
}


def maker(algo: str, widths: list[int], steps: int) -> Callable[..., Variant]:
    kind, env, batch = ALGOS[algo]
    if kind is PPO:
        return on_policy(kind, env, batch, batch * steps, net_arch=widths)
    return off_policy(kind, env, batch, steps, net_arch=widths)


def state_bytes(model: Any) -> int:
    """Count the bytes of parameters, targets, moments, gradients, masks and indices."""
    policy = model.policy
    tensors = {id(t): t for t in (*policy.parameters(), *policy.buffers())}
    for parameter in policy.parameters():
        if parameter.grad is not None:
            tensors[id(parameter.grad)] = parameter.grad
    structures = {}
    for module in policy.modules():
        if isinstance(module, SparseLinear):
            structures[id(module.structure)] = module.structure
        optimizer = getattr(module, "optimizer", None)
        for state in optimizer.state.values() if optimizer is not None else ():
            tensors.update({id(t): t for t in state.values() if isinstance(t, th.Tensor)})
    return sum(t.nbytes for t in tensors.values()) + sum(s.nbytes for s in structures.values())


def narrow(algo: str, width: int, parameters: int) -> list[int]:
    """Compute widths of the dense network with as many parameters."""

    def count(widths: list[int]) -> int:
        model, _, _ = maker(algo, widths, 1)("MlpPolicy", {})
        trained = {id(p): p for o in optimizers(model) for g in o.param_groups for p in g["params"]}
        return sum(p.numel() for p in trained.values())

    return equivalent_widths([width, width], count, parameters)[0]


def optimizers(model: Any) -> list[th.optim.Optimizer]:
    found = {id(o): o for m in model.policy.modules() if (o := getattr(m, "optimizer", None))}
    return list(found.values())


def time_steps(
    algo: str, width: int, sparsities: list[float], rounds: int, bf16: bool
) -> Iterator[dict]:
    """Time gradient steps at each sparsity beside their rivals."""
    steps = max(2, min(20, round(20 * (256 / width) ** 2)))
    make = maker(algo, [width, width], steps)
    for sparsity in sparsities:
        stock = make("MlpPolicy", {})
        fused = fused_like_stock(stock[0])
        variants: dict[str, Variant] = {
            "dense, stock": stock,
            "dense, fused Adam": make("MlpPolicy", dict(fused)),
            "masked": make("SparsePolicy", dict(sparsity=sparsity, compute="masked")),
            "sparse": make("SparsePolicy", dict(sparsity=sparsity, compute="sparse")),
            "auto": make("SparsePolicy", dict(sparsity=sparsity, compute="auto")),
        }
        report = variants["masked"][0].policy.sparsity_report()
        if sparsity:
            widths = narrow(algo, width, report.parameters)
            like = maker(algo, widths, steps)
            variants[f"narrow dense {widths[0]}"] = like("MlpPolicy", dict(fused))
        context: dict[str, Any] = {}
        if bf16:
            variants["dense bf16"] = make("MlpPolicy", dict(fused))
            context["dense bf16"] = lambda: th.autocast("cpu", dtype=th.bfloat16)

        def timed(name: str, train: Callable[[], None], context=context) -> Callable[[], None]:
            def run() -> None:
                with context.get(name, nullcontext)():
                    train()

            return run

        trains = {name: timed(name, train) for name, (_, train, _) in variants.items()}
        times = interleaved(trains, rounds)
        rows = rows_of("step", f"{algo} {width}", ALGOS[algo][2], sparsity, times, steps)
        for row in rows:
            model, _, _ = variants[row["variant"]]
            yield {**row, "megabytes": state_bytes(model) / 1e6}
        del variants, trains
        gc.collect()


# --- the rule of compute="auto" -----------------------------------------------------------------

BEHIND = 0.05
"""How much slower than the better storage auto may be, as a share."""


def sparse_layers(model: Any) -> list[str]:
    layers = model.policy.sparsity_report().layers
    return [layer.name for layer in layers if layer.compute == "sparse"]


def time_rule(
    algo: str, width: int, sparsity: float, activation: str, sets: list[str], rounds: int
) -> Iterator[dict]:
    """Time gradient steps with masks, in sparse storage and by the rule, in each instruction set.

    Where auto stores the same layers as one of the others, it is the same program and gets its
    times.
    """
    steps = max(2, min(20, round(20 * (256 / width) ** 2)))
    make = maker(algo, [width, width], steps)
    kwargs = dict(sparsity=sparsity, activation_fn=getattr(th.nn, activation))
    made = {
        name: make("SparsePolicy", dict(kwargs, compute=compute))
        for name, compute in (("masked", "masked"), ("sparse", "sparse"), ("auto", "auto"))
    }
    chosen = {name: sparse_layers(model) for name, (model, _, _) in made.items()}
    same = [name for name in ("masked", "sparse") if chosen[name] == chosen["auto"]]

    def stepped(name: str, instructions: str) -> Callable[[], None]:
        def run() -> None:
            use(instructions)
            made[name][1]()

        return run

    todo = {"masked": stepped("masked", sets[0])}  # no kernel of ours is in it
    for name in ("sparse",) if same else ("sparse", "auto"):
        todo |= {f"{name} {one}": stepped(name, one) for one in sets}
    times = interleaved(todo, rounds)
    for one in sets if same else ():
        times[f"auto {one}"] = times["masked" if same[0] == "masked" else f"sparse {one}"]
    yield from rows_of(
        "rule", f"{algo} {width} {activation}", ALGOS[algo][2], sparsity, times, steps
    )


def print_rule(rows: Iterable[Mapping[str, Any]]) -> None:
    """Print how far auto is behind the better storage, and where by more than 5 %."""
    cases: dict[tuple[str, str], dict[str, float]] = {}
    for row in rows:
        if row["what"] == "rule":
            case = cases.setdefault((row["case"], f"{float(row['sparsity']):.0%}"), {})
            case[row["variant"]] = float(row["speedup"])
    shares = {}
    for (case, sparsity), speedups in cases.items():
        for variant in [name for name in speedups if name.startswith("auto ")]:
            one = variant.removeprefix("auto ")
            auto, sparse = speedups[variant], speedups[f"sparse {one}"]
            told = f"{case} {sparsity} {one}: auto {auto:.2f}x, sparse {sparse:.2f}x of masked"
            shares[told] = max(1.0, sparse) / auto - 1
    worst = sorted(shares, key=lambda told: -shares[told])
    beyond = [told for told in worst if shares[told] > BEHIND]
    print(f"{len(beyond)} of {len(shares)} cases in which auto is more than {BEHIND:.0%} behind")
    for told in beyond:
        print(f"  {told}: {shares[told]:.1%} behind")


def table(path: Path) -> None:
    """Print a CSV file as Markdown: a line for each case, a column for each variant."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    for what in dict.fromkeys(row["what"] for row in rows):
        found: dict[tuple[str, ...], dict[str, dict[str, str]]] = {}
        for row in rows:
            if row["what"] == what:
                name = re.sub(r" \d+$", "", row["variant"])  # narrow dense 75
                key = (row["case"], row["batch"], f"{float(row['sparsity']):.0%}")
                found.setdefault(key, {})[name] = row
        variants = list(dict.fromkeys(name for case in found.values() for name in case))
        base, *others = variants
        print(f"| {what} | batch | sparsity | {base}, ms | {' | '.join(others)} | MB |")
        print("|---" * (len(variants) + 4) + "|")
        for key, case in found.items():
            cells = [f"{float(case[base]['milliseconds']):.3g}"]
            cells += [f"{float(case[o]['speedup']):.2f}" if o in case else "" for o in others]
            sizes = [case[v]["megabytes"] for v in ("dense, stock", "masked", "auto") if v in case]
            cells.append(" / ".join(f"{float(size):.3g}" for size in sizes if size))
            print("| " + " | ".join([*key, *cells]) + " |")
        print()
    if any(row["what"] == "rule" for row in rows):
        print_rule(rows)


FIELDS = ["what", "case", "batch", "sparsity", "variant", "milliseconds", "speedup", "megabytes"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--layers", action="store_true", help="only layers")
    parser.add_argument("--steps", action="store_true", help="only gradient steps")
    parser.add_argument("--algos", type=listed(str), default=["SAC", "TD3", "DQN", "PPO"])
    parser.add_argument("--rule", action="store_true", help='only what the rule of "auto" loses')
    parser.add_argument("--widths", type=listed(int))
    parser.add_argument("--sparsities", type=listed(float))
    parser.add_argument(
        "--activations", type=listed(str), default=["ReLU", "Tanh"], help="of --rule"
    )
    parser.add_argument(
        "--instructions", type=listed(str), help="of --rule; default: all there are"
    )
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--csv", type=Path, default=Path("sparse_compute.csv"))
    parser.add_argument("--table", type=Path, help="only print such a CSV file as Markdown")
    args = parser.parse_args()
    if args.table is not None:
        table(args.table)
        return
    args.widths = args.widths or ([32, 64, 128, 256, 512, 1024] if args.rule else [256, 1024])
    args.sparsities = args.sparsities or [*([0.5] if args.rule else []), 0.8, 0.9, 0.95, 0.99]
    th.set_num_threads(args.threads)
    bf16 = th.backends.mkldnn.is_available() and th.ops.mkldnn._is_mkldnn_bf16_supported()
    print(
        f"torch {th.__version__}, {args.threads} thread(s), {in_use()} kernels, "
        f"bf16 {'yes' if bf16 else 'no'}, median of {args.rounds} interleaved rounds\n"
    )
    everything = not (args.layers or args.steps or args.rule)
    rows: list[Iterator[dict]] = []
    if args.layers or everything:
        rows.append(time_layers(args.widths, args.sparsities, args.rounds))
        rows.append(time_single(args.widths, args.sparsities, args.rounds))
    if args.steps or everything:
        rows += [
            time_steps(algo, width, args.sparsities, args.rounds, bf16)
            for width in args.widths
            for algo in args.algos
        ]
    if args.rule:
        grid = product(args.widths, args.algos, args.sparsities, args.activations)
        sets = args.instructions or instruction_sets()
        rows += [
            time_rule(algo, width, sparsity, activation, sets, args.rounds)
            for width, algo, sparsity, activation in grid
        ]
    measured = []
    with appending(args.csv, FIELDS) as write:
        for part in rows:
            for row in part:
                write(row)
                measured.append(row)
                print(
                    f"{row['what']:<5} {row['case']:<26} batch {row['batch']:>3}  "
                    f"{row['sparsity']:.0%}  {row['variant']:<20} {row['milliseconds']:9.3f} ms  "
                    f"{row['speedup']:6.2f}x"
                    + (f"  {row['megabytes']:8.2f} MB" if "megabytes" in row else ""),
                    flush=True,
                )
    if args.rule:
        print_rule(measured)


if __name__ == "__main__":
    main()
