"""Policies in C on emulated microcontrollers: examples/microcontroller, built and run.

QEMU emulates a Cortex-M4 with FPU (netduinoplus2: STM32F405) and a Cortex-M0 (microbit: nRF51822),
whose instructions are those of a Cortex-M0+.
"""

import contextlib
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from export.test_c import BYTES
from export.tools import Task, random_chain
from gymnasium import spaces
from support import TinyImages, make

from sb3_sparse import cli
from sb3_sparse.export import export_policy
from sb3_sparse.export.c import write_c
from sb3_sparse.export.calibrate import integer_graph
from sb3_sparse.export.extract import graph_of
from sb3_sparse.export.observations import random_observations
from sb3_sparse.export.quantize import quantized

EXAMPLE = Path(__file__).parents[2] / "examples" / "microcontroller"
STUBS = Path(__file__).parent / "stubs"
BOARDS = ["m4f", "m0"]
COUNT = 1000
STACK = 512
"""Bytes that the files state."""

needs_compiler = pytest.mark.skipif(
    shutil.which("arm-none-eabi-gcc") is None,
    reason="needs arm-none-eabi-gcc: apt-get install gcc-arm-none-eabi libnewlib-arm-none-eabi",
)
needs_board = pytest.mark.skipif(
    any(shutil.which(name) is None for name in ("arm-none-eabi-gcc", "qemu-system-arm", "make")),
    reason="needs arm-none-eabi-gcc, qemu-system-arm and make: apt-get install gcc-arm-none-eabi "
    "libnewlib-arm-none-eabi qemu-system-arm make",
)
sys.path.insert(0, str(EXAMPLE))
from record import UNCOUNTED, compare, header, read, record, sections  # noqa: E402


@dataclass
class Said:
    """What the program on a board said, and its files."""

    actions: np.ndarray
    ticks: np.ndarray
    stack: int
    build: Path


def built(target, board, folder):
    """Make a target of the example; return what it prints."""
    build = folder / board
    command = ["make", "-s", "-f", str(EXAMPLE / "Makefile"), f"BOARD={board}", f"IN={folder}"]
    done = subprocess.run(
        [*command, f"BUILD={build}", target], capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def run_on(board, folder, observations):
    """Step the policy in a folder."""
    (folder / "observations.h").write_text(header(observations))
    actions, ticks, stack = read(built("run", board, folder))
    return Said(actions, ticks, stack, folder / board)


MODELS = {
    "SAC": lambda: make("SAC", policy_kwargs={"net_arch": [64, 64], "sparsity": 0.8}),
    "PPO": lambda: make("PPO", policy_kwargs={"sparsity": 0.5}),
    "DQN": lambda: make("DQN", policy_kwargs={"sparsity": 0.5}),
}


@needs_board
@pytest.mark.parametrize("board", BOARDS)
@pytest.mark.parametrize("name", sorted(MODELS))
def test_a_board_acts_as_the_model_does(name, board, tmp_path):
    model = MODELS[name]()
    export_policy(model, tmp_path / "policy", "c")
    observations = random_observations(model.observation_space, None, COUNT)
    said = run_on(board, tmp_path, observations)
    expected, _ = model.predict(observations, deterministic=True)
    expected = expected.reshape(COUNT, -1)
    assert np.ptp(expected) > 0.01
    np.testing.assert_allclose(said.actions, expected, rtol=0, atol=1e-5)


@needs_board
def test_files_left_beside_the_program_do_not_count(tmp_path, monkeypatch):
    example = shutil.copytree(EXAMPLE, tmp_path / "example")
    for name in ("policy.h", "observations.h"):
        (example / name).write_text("#error of another policy\n")
    monkeypatch.setattr(sys.modules[__name__], "EXAMPLE", example)
    model = MODELS["PPO"]()
    (tmp_path / "own").mkdir()
    export_policy(model, tmp_path / "own" / "policy", "c")
    observations = random_observations(model.observation_space, None, 3)
    assert len(run_on("m0", tmp_path / "own", observations).actions) == 3


@needs_board
@pytest.mark.parametrize(
    ("board", "said"), [("m1", "BOARD is m4f or m0, not m1"), ("m0", "sb3-sparse export MODEL")]
)
def test_make_says_what_is_missing(board, said, tmp_path):
    command = ["make", "-f", str(EXAMPLE / "Makefile"), f"BOARD={board}", f"IN={tmp_path}"]
    done = subprocess.run(
        [*command, f"BUILD={tmp_path / 'build'}"], capture_output=True, text=True, timeout=100
    )
    assert done.returncode != 0
    assert said in done.stderr


@needs_board
@pytest.mark.parametrize("board", BOARDS)
def test_eight_bit_weights_act_on_a_board_as_the_rounded_weights_do(board, tmp_path):
    model = MODELS["SAC"]()
    export_policy(model, tmp_path / "policy", "c", int8=True)
    observations = random_observations(model.observation_space, None, COUNT)
    said = run_on(board, tmp_path, observations)
    expected = quantized(graph_of(model, None)).run(observations)
    np.testing.assert_allclose(said.actions, expected, atol=1e-5)
    floats, _ = model.predict(observations, deterministic=True)
    assert np.abs(said.actions - floats).max() > 1e-5


@needs_board
@pytest.mark.parametrize("board", BOARDS)
def test_whole_numbers_are_the_same_on_every_board(board, tmp_path):
    random = np.random.default_rng(6)
    graph = random_chain(random, [9, 64, 300, 4], 0.2)
    observations = random.normal(size=(COUNT, 9)).astype(np.float32)
    whole = integer_graph(graph, observations[:100])
    written = write_c(whole, "0", int8=True)
    (tmp_path / "policy.c").write_text(written.source)
    (tmp_path / "policy.h").write_text(written.header)
    said = run_on(board, tmp_path, 3 * observations)
    np.testing.assert_array_equal(said.actions, whole.run(3 * observations))
    found = sections((said.build / "firmware.map").read_text())
    static = [size for name, size in found.items() if name.startswith(".bss")]
    assert sum(static) == written.ram
    assert said.stack < STACK


@needs_board
def test_whole_numbers_need_an_eighth_of_the_instructions_without_a_float_unit(tmp_path):
    random = np.random.default_rng(7)
    graph = random_chain(random, [17, 64, 64, 6], 0.2)
    observations = random.normal(size=(20, 17)).astype(np.float32)
    ticks = {}
    for name, policy, int8 in (
        ("floats", graph, False),
        ("whole", integer_graph(graph, observations), True),
    ):
        written = write_c(policy, "0", int8)
        folder = tmp_path / name
        folder.mkdir()
        (folder / "policy.c").write_text(written.source)
        (folder / "policy.h").write_text(written.header)
        ticks[name] = run_on("m0", folder, observations).ticks.mean()
    assert ticks["whole"] * 8 < ticks["floats"]  # both sparse: counted, not timed


@needs_board
@pytest.mark.parametrize(
    ("kind", "options"),
    [
        *[
            (kind, {"int8": int8})
            for kind in ("vectors", "images", "simba")
            for int8 in (False, True, "full")
        ],
        ("vectors", {"with_value": True, "stochastic": True}),
        ("choices", {"with_value": True, "stochastic": True}),
    ],
    ids=str,
)
def test_flash_ram_and_stack_are_as_stated(kind, options, tmp_path):
    models = {
        "vectors": MODELS["SAC"],
        "images": lambda: make("DQN", TinyImages()),
        "simba": lambda: make("SAC", policy="SparseSimbaPolicy"),
        "choices": lambda: make("PPO", "CartPole-v1"),
    }
    model = models[kind]()
    seen = random_observations(model.observation_space, None, 20)
    report = export_policy(model, tmp_path / "policy", "c", observations=seen, **options)
    source = (tmp_path / "policy.c").read_text()
    for board in BOARDS:
        check_sizes(report, source, run_on(board, tmp_path, seen[:5]))


def check_sizes(report, source, said):
    """Compare what is stated to the map of what was linked, and to the stack that was written."""
    found = sections((said.build / "firmware.map").read_text())

    static = [size for name, size in found.items() if name.startswith((".bss", ".data"))]
    assert sum(static) == report.sizes["RAM"]
    assert f"RAM: {sum(static)} bytes" in source

    tables = re.findall(r"^static const (\w+) (\w+)\[(\d+)\]", source, re.M)
    linked = {name: BYTES[kind] * int(size) for kind, name, size in tables}
    folded = {name for name in linked if f".rodata.{name}" not in found}  # into the code
    assert all(linked[name] <= 8 for name in folded)
    for name in linked.keys() - folded:
        assert found[f".rodata.{name}"] == linked[name]
    assert sum(linked.values()) == report.sizes["flash"]
    assert sum(size for name, size in found.items() if name.startswith(".text")) < 3000

    assert f"Stack: less than {STACK} bytes" in source
    assert 0 < said.stack < STACK
    frames = (said.build / "policy.su").read_text().splitlines()
    assert all(frame.split("\t")[2] == "static" for frame in frames)  # none depends on data
    own = {frame.split("\t")[0].split(":")[-1]: int(frame.split("\t")[1]) for frame in frames}
    callee = max((size for name, size in own.items() if name != "sb3_sparse_policy"), default=0)
    assert said.stack + 8 >= own["sb3_sparse_policy"] + callee  # frames end in unused words


SLOW = """
void sb3_sparse_policy(const float *obs, float *action);
void sb3_sparse_policy(const float *obs, float *action)
{
    unsigned long turns = (unsigned long)*obs;
    while (turns--)
        __asm__ volatile("nop");
    *action = *obs;
}
"""


@needs_board
@pytest.mark.parametrize("board", BOARDS)
def test_more_ticks_than_the_timer_counts_are_no_few_ticks(board, tmp_path, capsys):
    (tmp_path / "policy.h").write_text(
        "#define SB3_SPARSE_ACTION_SIZE 1\nvoid sb3_sparse_policy(const float *, float *);\n"
    )
    (tmp_path / "policy.c").write_text(SLOW)
    turns = np.float32([[10], [9e6], [1000]])  # 3 instructions a turn, 16.4 million ticks at most
    said = run_on(board, tmp_path, turns)
    assert said.ticks[1] == UNCOUNTED
    assert said.ticks[0] < 200
    assert 3000 < said.ticks[2] < 8000
    np.save(tmp_path / "actions.npy", turns)
    compare(built("run", board, tmp_path), tmp_path, 1e-5)
    assert "more ticks an action than the 16,777,215 that" in capsys.readouterr().out


def test_dicts_are_not_recorded(tmp_path, monkeypatch):
    make("PPO", "TinyDicts-v0").save(tmp_path / "model.zip")
    with pytest.raises(SystemExit, match="has dicts as observations, and this example writes"):
        record(tmp_path / "model.zip", 5, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]


@needs_board
def test_ticks_count_instructions(tmp_path):
    """1 ns each on a clock of 1/shift; the README says how many make a tick."""
    ticks = {}
    (tmp_path / "policy.h").write_text(
        "#define SB3_SPARSE_ACTION_SIZE 1\nvoid sb3_sparse_policy(const float *, float *);\n"
    )
    for count in (1000, 5000):
        (tmp_path / "policy.c").write_text(
            "void sb3_sparse_policy(const float *obs, float *action);\n"
            "void sb3_sparse_policy(const float *obs, float *action)\n"
            f'{{ *action = *obs; __asm__ volatile(".rept {count}\\n\\tnop\\n\\t.endr"); }}\n'
        )
        for board in BOARDS:
            ticks[board, count] = run_on(board, tmp_path, np.zeros((1, 1))).ticks[0]
    for board, each in (("m4f", 8 * 0.168), ("m0", 64 * 0.016)):
        more = float(ticks[board, 5000]) - float(ticks[board, 1000])
        assert abs(more / each - 4000) <= 1


@needs_board
def test_a_user_takes_the_readme_s_steps(tmp_path, monkeypatch):
    """Trains (for fewer steps), exports, records, builds, runs, and compares."""
    text = (EXAMPLE / "README.md").read_text()
    steps = re.search(r"<!-- steps -->\n```sh\n(.*?)```", text, re.S)[1].splitlines()
    shutil.copytree(EXAMPLE, tmp_path / "examples" / "microcontroller")
    monkeypatch.chdir(tmp_path)
    done = []
    for step in steps:
        first, *rest = shlex.split(step, comments=True)
        if first == "cd":
            monkeypatch.chdir(rest[0])
        elif first == "sb3-sparse":
            few = ["-n", "500", "--eval-episodes", "2"] if rest[0] == "train" else []
            monkeypatch.setattr("sys.argv", [first, *rest, *few])
            with contextlib.suppress(SystemExit):
                cli.main()
        elif first in ("python", "make"):
            command = step.replace("python ", f"{sys.executable} ")
            subprocess.run(["bash", "-euo", "pipefail", "-c", command], check=True)
        else:
            assert step.startswith("sudo apt-get install")
        done.append(first)
    assert done == ["sudo", "sb3-sparse", "cd", "sb3-sparse", "python", "make", "make"]
    for board in BOARDS:
        actions, _, _ = read(built("run", board, Path.cwd()))
        np.testing.assert_allclose(actions, np.load("actions.npy"), atol=1e-5)
        assert actions.shape == (COUNT, 1)


@needs_compiler
def test_the_crazyflie_s_controller_compiles_by_the_firmware_s_flags(tmp_path):
    """Without the firmware: tests/export/stubs declare what the app takes of it."""
    task = Task(spaces.Box(-1, 1, (13,), np.float32), spaces.Box(-1, 1, (4,), np.float32))
    export_policy(make("SAC", task), tmp_path / "policy", "c")
    options = [
        "-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16",
        "-mfp16-format=ieee", "-fno-math-errno", "-Os", "-std=gnu11", "-Wall", "-Wextra",
        "-Wmissing-braces", "-Wdouble-promotion", "-Werror", "-fno-strict-aliasing",
        "-ffunction-sections", "-fdata-sections",
    ]  # fmt: skip
    controller = EXAMPLE / "crazyflie" / "src" / "policy_controller.c"
    include = [f"-I{STUBS / 'crazyflie'}", f"-I{tmp_path}"]
    for source in (controller, tmp_path / "policy.c"):
        compile_for_arm("gcc", options, include, source, tmp_path)
    asked = undefined(tmp_path / "policy_controller.o")
    assert asked == {"consolePrintf", "sb3_sparse_policy", "vTaskDelay"}
    assert undefined(tmp_path / "policy.o") == {"tanhf"}


@needs_compiler
@pytest.mark.skipif(
    shutil.which("arm-none-eabi-g++") is None,
    reason="needs arm-none-eabi-g++: apt-get install gcc-arm-none-eabi",
)
def test_the_arduino_sketch_compiles_by_the_flags_of_a_cortex_m0_board(tmp_path):
    """Without Arduino's core: tests/export/stubs declare what the sketch takes of it."""
    export_policy(make("SAC"), tmp_path / "policy", "c")
    common = ["-mcpu=cortex-m0plus", "-mthumb", "-Os", "-Wall", "-Wextra", "-Werror"]
    common += ["-ffunction-sections", "-fdata-sections"]
    plus = ["-std=gnu++11", "-fno-threadsafe-statics", "-fno-rtti", "-fno-exceptions"]
    sketch = EXAMPLE / "arduino" / "policy_sketch" / "policy_sketch.ino"
    include = [f"-I{STUBS / 'arduino'}", f"-I{tmp_path}"]
    first = ["-x", "c++", "-include", "Arduino.h"]  # as Arduino's builder does
    compile_for_arm("g++", [*common, *plus], [*include, *first], sketch, tmp_path)
    compile_for_arm("gcc", [*common, "-std=gnu11"], [], tmp_path / "policy.c", tmp_path)
    assert "sb3_sparse_policy" in undefined(tmp_path / "policy_sketch.o")  # a C name


@needs_compiler
@pytest.mark.parametrize("asked", ["with_value", "stochastic"])
def test_firmware_says_that_it_takes_the_action_alone(asked, tmp_path):
    task = Task(spaces.Box(-1, 1, (13,), np.float32), spaces.Box(-1, 1, (4,), np.float32))
    export_policy(make("SAC", task), tmp_path / "policy", "c", **{asked: True})
    controller = EXAMPLE / "crazyflie" / "src" / "policy_controller.c"
    sketch = EXAMPLE / "arduino" / "policy_sketch" / "policy_sketch.ino"
    plus = ["-x", "c++", "-include", "Arduino.h"]
    for stub, compiler, options, source in (
        ("crazyflie", "gcc", [], controller),
        ("arduino", "g++", plus, sketch),
    ):
        command = [f"arm-none-eabi-{compiler}", f"-I{STUBS / stub}", f"-I{tmp_path}", *options]
        command += ["-c", str(source), "-o", "/dev/null"]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode != 0
        assert '"export policy.c without --with-value and --stochastic, or pass' in done.stderr


def compile_for_arm(compiler, options, include, source, folder):
    out = str(folder / f"{source.stem}.o")
    command = [f"arm-none-eabi-{compiler}", *options, *include, "-c", str(source), "-o", out]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""


def undefined(path):
    """Names that an object file takes from others, without those of the compiler's library."""
    said = subprocess.run(
        ["arm-none-eabi-nm", "-u", str(path)], capture_output=True, text=True, check=True
    ).stdout
    names = {line.split()[-1] for line in said.splitlines()}
    return {name for name in names if not name.startswith("__aeabi_")}
