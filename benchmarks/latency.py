"""Time of one action and bytes of a policy, in every form that can run it.

The policies are actors of SAC with random masks (ERK), at batch 1 on one thread. "narrow dense"
has as many parameters. All variants of a case are timed in turn in one process, in short
bursts; results are medians of bursts and of their ratios. Rows are appended to a CSV file
immediately.

    python benchmarks/latency.py                        # every case, two or three minutes
    python benchmarks/latency.py --sizes 17-256-256-6 --sparsities 95
"""

from __future__ import annotations

import argparse
import csv
import ctypes
import subprocess
import tempfile
from importlib import util
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch as th
from gymnasium import spaces
from random_env import RandomEnv
from stable_baselines3 import SAC

from sb3_sparse import SparsePolicy
from sb3_sparse.export import export_policy
from sb3_sparse.export.compiler import compiler
from sb3_sparse.export.timing import OPTIONS, Burst, c_burst, looped, measure, with_loop
from sb3_sparse.sparsity import equivalent_widths, mlp_parameters

SIZES = ("17-256-256-6", "348-256-256-17", "348-1024-1024-17")
SPARSITIES = (80, 90, 95, 99)
OBSERVATIONS = 64
NATIVE = (*OPTIONS, "-march=native")
KINDS = {"C": OPTIONS, "C, -O2": ("-std=c99", "-O2"), "C, -march=native": NATIVE}
Variants = dict[str, tuple[Burst, int]]
"""A burst and the bytes of its policy, by name."""


def bytes_of(source: Path, options: tuple[str, ...]) -> int:
    """Return the bytes of the code and constants of a policy."""
    code = source.with_suffix(".o")
    subprocess.run([*compiler(), *options, "-c", str(source), "-o", str(code)], check=True)
    said = subprocess.run(["size", str(code)], check=True, capture_output=True, text=True).stdout
    text, data, *_ = said.splitlines()[1].split()
    return int(text) + int(data)


def c_bursts(source: Path, rows: np.ndarray, actions: int, kinds: dict[str, Any]) -> Variants:
    """Make variants of a C artifact: in its own loop, with several options, and through ctypes."""
    found: Variants = {}
    pointer = ctypes.POINTER(ctypes.c_float)
    action = np.empty(actions, np.float32)
    where = action.ctypes.data_as(pointer)
    each = [row.ctypes.data_as(pointer) for row in rows]
    for number, (name, options) in enumerate(kinds.items()):
        library = with_loop(source, options, f"{source.stem}_{number}")
        policy, size = library.sb3_sparse_policy, bytes_of(source, options)
        policy.argtypes, policy.restype = [pointer, pointer], None
        found[name] = (c_burst(library, rows, actions), size)
        if options == OPTIONS and source.stem == "sparse":
            found["C through ctypes"] = (looped(lambda row, f=policy: f(row, where), each), size)
    return found


def session_of(path: Path) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def actor(sizes: list[int], sparsity: float) -> SAC:
    """Make an untrained actor with random biases, as a trained one has biases too."""
    inputs, *hidden, outputs = sizes
    space = spaces.Box(-np.inf, np.inf, (inputs,), np.float32)
    env = RandomEnv(space, spaces.Box(-1, 1, (outputs,), np.float32))
    sparse = dict(sparsity=sparsity, compute="masked")
    model = SAC(
        SparsePolicy if sparsity else "MlpPolicy",
        env,
        policy_kwargs=dict(net_arch=hidden, **(sparse if sparsity else {})),
        buffer_size=1,
        seed=0,
        device="cpu",
    )
    for name, parameter in model.actor.named_parameters():
        if name.endswith("bias"):
            parameter.data.normal_(0, 0.1)
    return model


def empty_session(folder: Path) -> Any:
    """Make an empty graph, to time a call of onnxruntime from Python."""
    number = onnx.TensorProto.FLOAT
    ends = [onnx.helper.make_tensor_value_info(name, number, [1, 1]) for name in ("obs", "action")]
    node = onnx.helper.make_node("Identity", ["obs"], ["action"])
    graph = onnx.helper.make_graph([node], "empty", ends[:1], ends[1:])
    opset = onnx.helper.make_opsetid("", 17)
    onnx.save(onnx.helper.make_model(graph, opset_imports=[opset], ir_version=8), folder / "e.onnx")
    return session_of(folder / "e.onnx")


def variants(sizes: list[int], sparsity: float, folder: Path) -> Variants:
    """Make the variants of one case; the others are compared to the first."""
    sparse, dense = actor(sizes, sparsity), actor(sizes, 0.0)
    rows = np.random.default_rng(0).normal(size=(OBSERVATIONS, sizes[0])).astype(np.float32)
    each = list(rows)
    report = export_policy(sparse, folder / "sparse", "c")
    export_policy(sparse, folder / "sparse", "numpy")
    export_policy(sparse, folder / "int8", "c", int8=True)
    export_policy(dense, folder / "dense", "onnx")
    widths, _ = equivalent_widths(
        sizes[1:-1],
        lambda hidden: mlp_parameters(sizes[0], hidden, sizes[-1]),
        report.nnz + sum(sizes[1:]),
    )
    export_policy(actor([sizes[0], *widths, sizes[-1]], 0.0), folder / "narrow", "c")
    weights = report.dense_bytes
    empty, nothing = empty_session(folder), {"obs": np.zeros((1, 1), np.float32)}
    session = session_of(folder / "dense.onnx")
    network = dense.policy.actor
    network.set_training_mode(False)
    spec = util.spec_from_file_location("numpy_policy", folder / "numpy_policy.py")
    assert spec is not None
    assert spec.loader is not None
    loader = util.module_from_spec(spec)
    spec.loader.exec_module(loader)
    policy = loader.Policy(folder / "sparse.npz")

    def torch_act(row: th.Tensor) -> th.Tensor:
        with th.no_grad():
            return th.tanh(network.mu(network.latent_pi(row)))

    return {
        "onnxruntime, dense": (
            looped(lambda row: session.run(None, {"obs": row}), [row[None] for row in each]),
            (folder / "dense.onnx").stat().st_size,
        ),
        "onnxruntime, empty graph": (looped(lambda row: empty.run(None, nothing), each), 0),
        "model.predict, dense": (
            looped(lambda row: dense.predict(row, deterministic=True), each),
            weights,
        ),
        "torch, dense": (looped(torch_act, [th.as_tensor(row)[None] for row in each]), weights),
        "numpy": (looped(policy, each), (folder / "sparse.npz").stat().st_size),
        **c_bursts(folder / "sparse.c", rows, sizes[-1], KINDS),
        **c_bursts(folder / "int8.c", rows, sizes[-1], {"C, int8": OPTIONS}),
        **c_bursts(folder / "narrow.c", rows, sizes[-1], {"C, narrow dense": OPTIONS}),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", default=",".join(SIZES))
    parser.add_argument("--sparsities", default=",".join(map(str, SPARSITIES)), help="percent")
    parser.add_argument("--rounds", type=int, default=61)
    parser.add_argument("--out", type=Path, default=Path("latency.csv"))
    args = parser.parse_args()
    th.set_num_threads(1)
    with args.out.open("a", newline="") as file:
        names = ["sizes", "sparsity", "variant", "microseconds", "speedup", "bytes", "smaller"]
        writer = csv.DictWriter(file, names)
        if not file.tell():
            writer.writeheader()
        for sizes in args.sizes.split(","):
            for percent in map(int, args.sparsities.split(",")):
                with tempfile.TemporaryDirectory() as folder:
                    units = [int(size) for size in sizes.split("-")]
                    found = variants(units, percent / 100, Path(folder))
                    bursts = {name: burst for name, (burst, _) in found.items()}
                    each = measure(list(bursts.values()), args.rounds)
                times = dict(zip(bursts, each, strict=True))
                base = next(iter(times.values()))
                weights = found["torch, dense"][1]
                for name, seconds in times.items():
                    ratios = [a / b for a, b in zip(base, seconds, strict=True)]
                    row = {
                        "sizes": sizes,
                        "sparsity": percent,
                        "variant": name,
                        "microseconds": f"{1e6 * median(seconds):.3g}",
                        "speedup": f"{median(ratios):.3g}",
                        "bytes": found[name][1] or "",
                        "smaller": f"{weights / found[name][1]:.3g}" if found[name][1] else "",
                    }
                    writer.writerow(row)
                    print(*(f"{value!s:<16}" for value in row.values()), flush=True)
                file.flush()


if __name__ == "__main__":
    main()
