"""The benchmark of sparse storage: what it times, and what it says of ``compute="auto"``."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import pytest
import torch as th
from torch.nn import functional

from sb3_sparse.engine.native.library import in_use, instruction_sets, use
from sb3_sparse.engine.sequential import ChainedSequential
from sb3_sparse.errors import ConfigError

BENCHMARKS = Path(__file__).parent.parent.parent / "benchmarks"


@pytest.fixture
def sparse_compute(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import sparse_compute

    instructions, threads = in_use(), th.get_num_threads()
    yield sparse_compute
    use(instructions)
    th.set_num_threads(threads)


@pytest.fixture
def measured(sparse_compute, monkeypatch, tmp_path):
    """Run the benchmark for one round; return the rows of its file."""
    path = tmp_path / "rows.csv"

    def run(*words: str) -> list[dict[str, str]]:
        argv = ["sparse_compute.py", *words, "--rounds", "1", "--csv", str(path)]
        monkeypatch.setattr(sys, "argv", argv)
        sparse_compute.main()
        with path.open(newline="") as file:
            return list(csv.DictReader(file))

    return run


def row(variant: str, speedup: float, sparsity: float = 0.5) -> dict[str, object]:
    case = dict(what="rule", case="DQN 256 ReLU", batch=128, sparsity=sparsity)
    return dict(case, variant=variant, speedup=speedup)


def test_the_rule_is_behind_the_better_of_its_two_choices(sparse_compute, capsys):
    half = [row("masked", 1.0), row("sparse avx2", 1.5), row("auto avx2", 1.0)]
    near = [row("masked", 1.0, 0.9), row("sparse avx2", 2.0, 0.9), row("auto avx2", 1.95, 0.9)]
    slow = [row("masked", 1.0, 0.8), row("sparse avx2", 0.5, 0.8), row("auto avx2", 0.8, 0.8)]
    sparse_compute.print_rule([*half, *near, *slow, dict(half[1], what="step")])
    slower = "  DQN 256 ReLU 80% avx2: auto 0.80x, sparse 0.50x of masked: 25.0% behind"
    assert capsys.readouterr().out.splitlines() == [
        "2 of 3 cases in which auto is more than 5% behind the better storage; at most 50.0%",
        "  DQN 256 ReLU 50% avx2: auto 1.00x, sparse 1.50x of masked: 50.0% behind",
        slower,
        "1 of 3 cases in which auto is more than 5% behind masked; at most 25.0%",
        slower,
    ]


def test_the_rule_is_measured_in_every_instruction_set(measured):
    grid = ["--algos", "DQN", "--widths", "16", "--sparsities", "0.9", "--activations", "Tanh"]
    rows = {one["variant"]: one for one in measured("--rule", *grid)}
    sets = instruction_sets()
    named = [f"{name} {one}" for name in ("sparse", "auto") for one in sets]
    assert list(rows) == ["masked", *named]
    assert {one["case"] for one in rows.values()} == {"DQN 16 Tanh"}
    for one in sets:  # so small that auto keeps masks, and so is the same program
        assert rows[f"auto {one}"]["milliseconds"] == rows["masked"]["milliseconds"]
        assert rows[f"auto {one}"]["speedup"] == "1.0"


def test_the_rule_of_an_instruction_set_is_the_one_that_is_measured(measured):
    grid = ["--algos", "DQN", "--widths", "128", "--sparsities", "0.6", "--activations", "ReLU"]
    before = in_use()
    rows = {one["variant"]: one for one in measured("--rule", *grid)}
    assert in_use() == before
    for one in instruction_sets():
        # More than a quarter of the connections are active, and less than half.
        chosen = f"sparse {one}" if one in ("avx512", "avx2") else "masked"
        assert rows[f"auto {one}"]["milliseconds"] == rows[chosen]["milliseconds"]


def test_the_rule_is_measured_on_images_from_no_sparsity_on(sparse_compute, monkeypatch):
    words = ["--images", "--rule", "--networks", "impala", "--distributions", "uniform"]
    monkeypatch.setattr(sys, "argv", ["sparse_compute.py", *words])
    args = sparse_compute.arguments()
    assert args.sparsities[0] == 0
    assert [case.name for case in sparse_compute.image_cases(args)] == ["DQN impala uniform"]


def test_a_layer_is_timed_alone_and_between_others(measured, monkeypatch):
    import convolutions

    monkeypatch.setattr(convolutions, "WORK", 1)
    few = ["--convolutions", "11 wide", "--sparsities", "0.9,0.95"]
    rows = measured("--images", "--layers", *few)
    assert {one["what"] for one in rows} == {"conv"}
    cases = {}
    for one in rows:
        cases.setdefault((one["case"], one["sparsity"]), []).append(one["variant"])
    alone = ["dense", "sparse, images"]
    if any(one["variant"] == "dense bf16" for one in rows):
        alone.append("dense bf16")
    assert cases == {
        (f"3x3, {channels}, 11 wide", sparsity): [*alone, *maps]
        for channels, maps in (
            ("32 to 32", ["sparse, maps"]),
            ("32 to 64", []),  # the channels do not fit
            ("64 to 64", ["sparse, maps"]),
        )
        for sparsity in ("0.9", "0.95")
    }


def test_a_case_tells_how_many_threads_it_had(measured, monkeypatch):
    import convolutions

    monkeypatch.setattr(convolutions, "WORK", 1)
    few = ["--convolutions", "9 wide", "--sparsities", "0.9", "--threads", "2"]
    rows = measured("--images", "--layers", *few)
    assert {one["case"] for one in rows} == {"3x3, 64 to 64, 9 wide, 2 threads"}


def test_a_layer_of_a_chain_takes_what_it_adds(sparse_compute):
    import convolutions

    assert convolutions.added([1.0, 2.0], [9.0, 4.0]) == [2.0, 0.5]  # four more layers


@pytest.mark.parametrize(
    ("name", "result", "operations"),
    [
        # Twice a forward pass of two operations a weight and place, for input and weights.
        ("3x3, 64 to 64, 21 wide", 21, 6 * 32 * 36_864 * 441),
        ("8x8/4, 4 to 32, 84 wide", 20, 6 * 32 * 8_192 * 400),
        ("4x4/2, 32 to 64, 20 wide", 9, 6 * 32 * 32_768 * 81),
        ("3x3, 64 to 64, 9 wide", 7, 6 * 32 * 36_864 * 49),
    ],
)
def test_a_convolution_is_what_its_name_says(sparse_compute, name, result, operations):
    import convolutions

    (layer,) = [one for one in convolutions.LAYERS if str(one) == name]
    network = convolutions.network(layer, 1, 0.95)
    assert type(network) is ChainedSequential
    convolution = network[0]
    assert convolution.weight.numel() == round(0.05 * convolution.dense().numel())
    x = th.rand(2, layer.inputs, layer.width, layer.width)
    window = (layer.stride, layer.padding)
    y = functional.conv2d(x, convolution.dense(), convolution.bias, *window).relu()
    assert y.shape == (2, layer.outputs, result, result)
    assert th.allclose(network(x), y, atol=1e-5)
    assert layer.operations == operations


def test_gradient_steps_on_images_have_rivals_with_as_many_parameters(measured, monkeypatch):
    import gradient_steps

    monkeypatch.setitem(gradient_steps.EXTRACTORS, "nature", (gradient_steps.ScaledNatureCNN, 1))
    words = ["--networks", "nature", "--distributions", "uniform", "--sparsities", "0.9"]
    rows = measured("--images", "--steps", *words)
    assert {one["case"] for one in rows} == {"DQN nature uniform"}
    assert {one["batch"] for one in rows} == {"32"}
    names = ["dense, stock", "dense, fused Adam", "masked", "sparse", "auto", "narrow dense 10"]
    assert [one["variant"] for one in rows][:6] == names
    size = {one["variant"]: float(one["megabytes"]) for one in rows}
    # Parameters, targets, gradients and two moments, of 1,687,206 numbers of four bytes.
    assert size["dense, stock"] == pytest.approx(5 * 4 * 1.687206, rel=1e-3)
    assert size["narrow dense 10"] == pytest.approx(0.1 * size["dense, stock"], rel=0.1)
    assert size["sparse"] < 0.25 * size["masked"]


@pytest.mark.parametrize(("net", "parameters"), [("nature", 1_687_206), ("impala", 4_357_542)])
def test_the_narrow_network_of_all_parameters_is_the_network(sparse_compute, net, parameters):
    case = sparse_compute.of_images(net)
    assert case.narrow(parameters).sizes == case.sizes == (32, 64, 64, 512)
    with pytest.raises(ConfigError, match=f"above the {parameters} of the full"):
        case.narrow(parameters + 1)


def test_acting_on_an_image_is_timed_with_and_without_the_policy(measured):
    words = ["--networks", "nature", "--distributions", "erk", "--sparsities", "0.95"]
    rows = measured("--images", "--acting", *words)
    assert [(one["what"], one["variant"]) for one in rows] == [
        (what, variant)
        for what in ("one", "predict")
        for variant in ("dense, stock", "masked", "sparse", "auto")
    ]
    assert all(float(one["milliseconds"]) > 0 for one in rows)


def test_an_unknown_network_is_rejected_at_once(sparse_compute, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["sparse_compute.py", "--images", "--networks", "resnet"])
    with pytest.raises(SystemExit):
        sparse_compute.main()
    assert "--networks: one of nature, impala; got resnet" in capsys.readouterr().err
