"""Instructions, flash and RAM of one action on emulated microcontrollers.

The policies are actors of SAC with random masks (ERK), run by examples/microcontroller on a
Cortex-M4F and a Cortex-M0+ under QEMU. Beside them stand a dense loop in plain C and emlearn's
network, with the weights of the dense actor. Needs arm-none-eabi-gcc, qemu-system-arm and make.

SysTick counts the instructions: with QEMU's -icount every instruction takes equally long. (Debian's
QEMU ships no plugin that counts, and emulates no DWT.) The count is exact to 2 instructions,
includes 9 of the call and the clock, and is a mean over five observations. Flash is the code and
constants of the policy as linked, without the compiler's and the math library, which all of them
share; RAM is static; the stack is what was written to.

    python benchmarks/microcontroller.py                   # every case, half a minute
    pip install --no-deps --target DIR emlearn==0.23.2     # for --emlearn DIR
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch as th
from latency import actor

from sb3_sparse.export import export_policy

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "microcontroller"
sys.path.insert(0, str(EXAMPLE))
from record import UNCOUNTED, header, read, sections  # noqa: E402

SIZES = ("17-64-64-6", "17-256-256-6")
SPARSITIES = (0, 80, 90, 95, 99)
OBSERVATIONS = 5
CLOCKS = {
    "m4f": ("-machine netduinoplus2 -icount shift=3", 8 * 0.168),
    "m0": ("-machine microbit -icount shift=5 -global nrf51-soc.flash-size=1048576", 32 * 0.016),
}
"""Options of QEMU, and ticks of SysTick that an instruction takes. Wide dense networks need more
flash than an nRF51822 has."""
CALL = "void sb3_sparse_policy(const float *obs, float *action)"
LAYER = """
static void layer_{n}(const float *x, float *y)
{{
    int i, j;
    for (i = 0; i < {outputs}; i++) {{
        float sum = bias_{n}[i];
        for (j = 0; j < {inputs}; j++)
            sum += weight_{n}[i][j] * x[j];
        y[i] = {activation};
    }}
}}
"""


def layers(model: object) -> list[tuple[np.ndarray, np.ndarray]]:
    """Weights and biases of an actor."""
    network = model.actor  # type: ignore[attr-defined]
    linear = [part for part in network.latent_pi if isinstance(part, th.nn.Linear)]
    linear.append(network.mu)
    return [(one.weight.detach().numpy(), one.bias.detach().numpy()) for one in linear]


def table(name: str, numbers: np.ndarray) -> str:
    shape = "".join(f"[{size}]" for size in numbers.shape)
    rows = numbers.reshape(len(numbers), -1)
    texts = [", ".join(f"{float(x).hex()}f" for x in row) for row in rows]
    body = ",\n".join(f"{{{text}}}" if numbers.ndim > 1 else text for text in texts)
    return f"static const float {name}{shape} = {{\n{body}\n}};\n"


def dense_loop(model: object) -> str:
    """A dense network as one would write it by hand."""
    found, last = layers(model), len(layers(model)) - 1
    source = "#include <math.h>\n" + f"{CALL};\n"
    calls, x = [], "obs"
    for n, (weight, bias) in enumerate(found):
        outputs, inputs = weight.shape
        activation = "tanhf(sum)" if n == last else "sum > 0.0f ? sum : 0.0f"
        source += table(f"weight_{n}", weight) + table(f"bias_{n}", bias)
        source += LAYER.format(n=n, outputs=outputs, inputs=inputs, activation=activation)
        y = "action" if n == last else f"hidden_{n}"
        if n < last:
            source += f"static float hidden_{n}[{outputs}];\n"
        calls.append(f"layer_{n}({x}, {y});")
        x = y
    return source + f"{CALL} {{ {' '.join(calls)} }}\n"


def emlearn_network(model: object) -> str:
    """The same by emlearn's C functions, as its converter writes it for an MLP."""
    found = layers(model)
    source, rows = f"#include <eml_net.h>\n{CALL};\n", []
    for n, (weight, bias) in enumerate(found):
        source += table(f"weight_{n}", weight.T.reshape(-1)) + table(f"bias_{n}", bias)
        kind = "Tanh" if n == len(found) - 1 else "Relu"
        rows.append(
            f"{{{len(weight)}, {weight.shape[1]}, weight_{n}, bias_{n}, EmlNetActivation{kind}}}"
        )
    most = max(max(weight.shape) for weight, _ in found)
    inputs, outputs = found[0][0].shape[1], len(found[-1][0])
    return source + (
        f"static const EmlNetLayer layers[] = {{{', '.join(rows)}}};\n"
        f"static float first[{most}], second[{most}];\n"
        f"static EmlNet net = {{{len(found)}, layers, first, second, {most}}};\n"
        f"{CALL}\n{{\n    int i;\n    (void)eml_net_infer(&net, obs, {inputs});\n"
        f"    for (i = 0; i < {outputs}; i++)\n        action[i] = second[i];\n}}\n"
    )


def measure(folder: Path, board: str, options: str, expected: np.ndarray, within: float) -> dict:
    """Run the policy of a folder on a board, and look into the map."""
    qemu, each = CLOCKS[board]
    build = folder / board
    command = ["make", "-s", "-f", str(EXAMPLE / "Makefile"), f"BOARD={board}", f"IN={folder}"]
    command += [f"BUILD={build}", f"CFLAGS={options}", f"QEMU_{board}={qemu}"]
    command += ["LDFLAGS=-Wl,--defsym=FLASH_SIZE=1048576", "run"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    actions, ticks, stack = read(done.stdout)
    np.testing.assert_allclose(actions, expected, atol=within)
    assert (ticks != UNCOUNTED).all()
    found = sections((build / "firmware.map").read_text())
    ram = sum(size for name, size in found.items() if name.startswith((".bss", ".data")))
    flash = sum(size for name, size in found.items() if name.startswith((".text", ".rodata")))
    return {
        "instructions": round(float(ticks.mean()) / each),
        "flash": flash,
        "ram": ram,
        "stack": stack,
    }


def cases(sizes: list[int], sparsities: list[int], emlearn: Path | None, folder: Path):
    """Write the policies of one size; yield what each is, its folder, options, and actions."""
    seen = np.random.default_rng(0).normal(size=(1000, sizes[0])).astype(np.float32)
    rows = seen[:OBSERVATIONS]

    def made(name: str) -> Path:
        (folder / name).mkdir()
        (folder / name / "observations.h").write_text(header(rows))
        return folder / name

    dense = actor(sizes, 0.0)
    actions, _ = dense.predict(rows, deterministic=True)
    declared = f"#define SB3_SPARSE_ACTION_SIZE {sizes[-1]}\n{CALL};\n"
    sources = {"dense loop": (dense_loop(dense), "-O2")}
    if emlearn is not None:
        sources["emlearn"] = (emlearn_network(dense), f"-O2 -w -I{emlearn / 'emlearn'}")
    for name, (source, options) in sources.items():
        where = made(name.split()[-1])
        (where / "policy.c").write_text(source)
        (where / "policy.h").write_text(declared)
        yield "", name, where, options, actions, 1e-5
    for percent in sparsities:
        model = actor(sizes, percent / 100)
        actions, _ = model.predict(rows, deterministic=True)
        for name, int8 in (("float", False), ("int8", "weights"), ("int8 full", "full")):
            where = made(f"{name.replace(' ', '_')}{percent}")
            recorded = seen if int8 == "full" else None
            export_policy(model, where / "policy", "c", int8=int8, observations=recorded)
            yield percent, name, where, "-O2", actions, 0.02 if int8 else 1e-5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", default=",".join(SIZES))
    parser.add_argument("--sparsities", default=",".join(map(str, SPARSITIES)), help="percent")
    parser.add_argument("--emlearn", type=Path, help="folder where emlearn is installed")
    parser.add_argument("--out", type=Path, default=Path("microcontroller.csv"))
    args = parser.parse_args()
    th.set_num_threads(1)
    names = ["sizes", "board", "variant", "sparsity", "instructions", "fewer", "flash", "smaller"]
    with args.out.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*names, "ram", "stack"])
        writer.writeheader()
        for sizes in args.sizes.split(","):
            bases: dict[str, dict] = {}
            units = [int(size) for size in sizes.split("-")]
            percents = [int(percent) for percent in args.sparsities.split(",")]
            with tempfile.TemporaryDirectory() as folder:
                for percent, name, where, options, actions, within in cases(
                    units, percents, args.emlearn, Path(folder)
                ):
                    for board in CLOCKS:
                        found = measure(where, board, options, actions, within)
                        base = bases.setdefault(board, found)  # the dense loop comes first
                        row = {"sizes": sizes, "board": board, "variant": name, "sparsity": percent}
                        row |= found
                        row["fewer"] = f"{base['instructions'] / found['instructions']:.3g}"
                        row["smaller"] = f"{base['flash'] / found['flash']:.3g}"
                        writer.writerow(row)
                        file.flush()
                        print(*(f"{row[key]!s:<13}" for key in writer.fieldnames), flush=True)


if __name__ == "__main__":
    main()
