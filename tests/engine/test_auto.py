from __future__ import annotations

import json

import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.logger import HumanOutputFormat, Logger
from torch import nn

from sb3_sparse import SparsityCallback
from sb3_sparse.engine import auto, timing
from sb3_sparse.engine.auto import AutoCompute, choose, runs_of
from sb3_sparse.engine.compact import CompactLayer
from sb3_sparse.engine.masked import MaskedLayer
from sb3_sparse.engine.native import library
from sb3_sparse.engine.timing import Timing


def layers_of(root: nn.Module, sparsity: float = 0.5) -> list[MaskedLayer]:
    layers = []
    for name, module in root.named_modules():
        if isinstance(module, (nn.Linear, nn.Conv2d)):
            layer = MaskedLayer(name, module)
            mask = th.rand(layer.size, generator=th.Generator().manual_seed(0)) >= sparsity
            layer.set_mask(mask.numpy())
            layers.append(layer)
    return layers


@pytest.fixture
def timings(monkeypatch):
    """Made-up timings by shape, in place of measured ones."""
    known: dict[tuple[int, int], Timing] = {}
    monkeypatch.setattr(auto, "timing_of", lambda shape, nnz, batch: known[shape])
    known[1, 1] = Timing(0.0, 0.0, 0.0)
    monkeypatch.setattr(auto, "WORTH_MEASURING", 1)
    return known


def test_runs_are_linear_layers_with_activations_between_them():
    root = nn.Sequential(
        nn.Sequential(
            nn.Linear(2, 3), nn.ReLU(), nn.Linear(3, 4), nn.LayerNorm(4), nn.Linear(4, 5)
        ),
        nn.Conv2d(1, 1, 1),
        nn.Linear(6, 7),
    )
    names = [[layer.name for layer in run] for run in runs_of(root, layers_of(root))]
    assert names == [["2"], ["0.0", "0.2"], ["0.4"]]


def test_each_layer_is_stored_as_is_quicker(timings):
    # Kept apart by a LayerNorm: 1.0 or 0.4 + 0.1 there, 1.0 or 0.9 + 0.2 here.
    root = nn.Sequential(nn.Linear(2, 3), nn.LayerNorm(3), nn.Linear(3, 4))
    timings.update({(3, 2): Timing(1.0, 0.4, 0.1), (4, 3): Timing(1.0, 0.9, 0.2)})
    choice = choose(root, layers_of(root), batch=8)
    assert choice.compact == ("0",)
    assert [layer.chosen_seconds for layer in choice.layers] == [pytest.approx(0.5), 1.0]
    assert choice.speedup == pytest.approx(2.0 / 1.5)


def test_conversions_count_only_where_a_compact_layer_meets_something_else(timings):
    # Alone, the middle one would lose (0.8 + 0.6 > 1); between compact ones it converts nothing.
    root = nn.Sequential(nn.Linear(3, 3), nn.ReLU(), nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 4))
    timings.update(
        {(3, 3): Timing(1.0, 0.1, 0.6), (4, 3): Timing(1.0, 0.8, 0.6), (4, 4): Timing(1, 0.1, 0.6)}
    )
    choice = choose(root, layers_of(root), batch=8)
    assert choice.compact == ("0", "2", "4")
    assert sum(layer.chosen_seconds for layer in choice.layers) == pytest.approx(
        0.1 + 0.8 + 0.1 + 0.6
    )


def test_layers_that_follow_each_other_share_the_cost_of_the_call(timings):
    # The second alone takes 1.1 of masked, but 0.3 of that is the call that the first makes anyway.
    root = nn.Sequential(nn.Linear(3, 3), nn.ReLU(), nn.Linear(3, 4))
    timings.update({(3, 3): Timing(2.0, 0.5, 0.1), (4, 3): Timing(1.0, 1.1, 0.1)})
    assert choose(root, layers_of(root), 8).compact == ("0",)
    timings[1, 1] = Timing(0.0, 0.3, 0.0)
    choice = choose(root, layers_of(root), 8)
    assert choice.compact == ("0", "2")
    total = sum(layer.chosen_seconds for layer in choice.layers)
    assert total == pytest.approx(0.5 + 0.1 * 3 / 6 + (1.1 - 0.3) + 0.1 * 4 / 7)


def test_a_run_that_gains_less_than_a_tenth_stays_masked(timings):
    root = nn.Sequential(nn.Linear(2, 3))
    timings[(3, 2)] = Timing(1.0, 0.85, 0.06)
    assert choose(root, layers_of(root), 8).compact == ()
    timings[(3, 2)] = Timing(1.0, 0.85, 0.04)
    assert choose(root, layers_of(root), 8).compact == ("0",)


@pytest.mark.parametrize(
    ("sparsity", "shape", "reason"),
    [(0.9, (50, 40), "no linear layer is sparse and has 32,768"), (0.0, (400, 400), "no linear")],
)
def test_small_and_full_layers_are_not_even_measured(sparsity, shape, reason, monkeypatch):
    monkeypatch.setattr(auto, "timing_of", lambda *_: pytest.fail("measured"))
    root = nn.Sequential(nn.Linear(*shape))
    choice = choose(root, layers_of(root, sparsity), 8)
    assert choice.reason is not None
    assert str(choice).startswith(f"compute='auto' keeps masks: {reason}")
    assert choice.speedup == 1.0


def test_missing_kernels_keep_masks_and_say_why(monkeypatch, tmp_path):
    monkeypatch.setattr(library, "PATH", tmp_path / "none.so")
    library.library.cache_clear()
    root = nn.Sequential(nn.Linear(400, 400))
    reason = choose(root, layers_of(root), 8).reason
    library.library.cache_clear()
    assert reason is not None
    assert "were not compiled when sb3-sparse was installed" in reason


def test_timings_are_measured_once_and_remembered_in_a_file(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(timing, "_known", {})
    before = th.get_rng_state()
    found = timing.timing_of((40, 30), 123, 70)
    assert (th.get_rng_state() == before).all()
    assert min(found.masked, found.compact) > 0
    monkeypatch.setattr(timing, "_measure", lambda *_: pytest.fail("measured again"))
    assert timing.timing_of((40, 30), 118, 70) is found  # two digits count: 120
    monkeypatch.setattr(timing, "_known", {})
    assert timing.timing_of((40, 30), 123, 70) == found
    (key,) = json.loads(timing.cache_path().read_text())
    assert key.endswith("|40|30|120|70")


def test_a_damaged_cache_is_measured_anew(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(timing, "_known", {})
    timing.cache_path().parent.mkdir()
    timing.cache_path().write_text("{half")
    assert timing.timing_of((4, 3), 5, 7).masked > 0
    assert len(json.loads(timing.cache_path().read_text())) == 1


def test_without_a_home_timings_are_measured_all_the_same(monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(timing, "_known", {})

    def nowhere() -> None:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(timing.Path, "home", nowhere)
    assert timing.timing_of((4, 3), 5, 7).masked > 0


def test_measuring_minds_no_default_of_torch(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(timing, "_known", {})
    th.set_default_dtype(th.float64)
    try:
        with th.inference_mode(), th.autocast("cpu", dtype=th.bfloat16), th.device("meta"):
            found = timing.timing_of((300, 300), 900, 64)
    finally:
        th.set_default_dtype(th.float32)
    assert found.masked > 1e-5


def test_what_is_compact_stays_so_in_later_choices(timings):
    root = nn.Sequential(nn.Linear(2, 3), nn.ReLU(), nn.Linear(3, 4))
    layers = layers_of(root)
    layers[0] = CompactLayer(layers[0])
    timings.update({(3, 2): Timing(1.0, 2.0, 0.1), (4, 3): Timing(1.0, 0.2, 0.1)})
    choice = choose(root, layers, 8)
    assert choice.compact == ("0", "2")
    timings[(4, 3)] = Timing(1.0, 2.0, 0.1)
    assert choose(root, layers, 8).compact == ("0",)


def test_masks_that_are_quicker_everywhere_are_said_so(timings):
    root = nn.Sequential(nn.Linear(2, 3))
    timings[(3, 2)] = Timing(0.001, 0.002, 0.001)
    assert str(choose(root, layers_of(root), 8)) == (
        "compute='auto' (batch 8): masks are quicker in all 1 layers measured (1.00 ms forward and "
        "backward)"
    )


def model_on_auto(monkeypatch, quicker: bool, **policy_kwargs):
    fake = Timing(1.0, 0.2 if quicker else 2.0, 0.1)
    call = Timing(0.0, 0.0, 0.0)
    monkeypatch.setattr(auto, "timing_of", lambda shape, *_: call if shape == (1, 1) else fake)
    monkeypatch.setattr(auto, "WORTH_MEASURING", 200)
    return SAC(
        "SparsePolicy",
        "Pendulum-v1",
        learning_starts=20,
        batch_size=48,
        seed=0,
        policy_kwargs=dict(sparsity=0.9, net_arch=[20, 20], **policy_kwargs),
    )


def compact_names(model) -> list[str]:
    return [layer.name for layer in model.policy.sparse.layers if layer.compact]


def test_training_begins_masked_and_changes_where_that_is_quicker(monkeypatch, tmp_path, capsys):
    model = model_on_auto(monkeypatch, quicker=True)
    model.set_logger(Logger(None, [HumanOutputFormat(str(tmp_path / "log"))]))
    model.learn(21, callback=SparsityCallback("rigl", update_interval=2))
    assert compact_names(model) == []
    assert model.policy.sparse.auto.batch == 48
    model.learn(30, callback=SparsityCallback("rigl", update_interval=2))
    assert "critic.qf0.2" in compact_names(model)
    assert "actor.mu" not in compact_names(model)  # alone and too small
    model.save(tmp_path / "model")
    resumed = SAC.load(tmp_path / "model", env=model.get_env())
    assert compact_names(resumed) == []
    resumed.policy.set_training_mode(True)
    assert compact_names(resumed) == compact_names(model)
    model.logger.dump()
    text = (tmp_path / "log").read_text()
    assert "compute='auto' (batch 48, " in text
    assert "times faster" in text
    assert "expected_speedup" in text


def test_training_stays_masked_where_that_is_quicker(monkeypatch):
    model = model_on_auto(monkeypatch, quicker=False).learn(30)
    assert compact_names(model) == []
    assert model.policy.sparse.auto.choice.speedup == 1.0


def test_pruning_chooses_again_when_half_is_gone(monkeypatch):
    model = model_on_auto(monkeypatch, quicker=True, initial_sparsity=0.0)
    callback = SparsityCallback("prune", update_interval=1, begin=0.3, end=0.9)
    choices = []
    choose_again = AutoCompute.choose

    def spied(self, root, layers):
        choice = choose_again(self, root, layers)
        if choice is not None:
            choices.append((sum(layer.nnz for layer in layers), choice.compact))
        return choice

    monkeypatch.setattr(AutoCompute, "choose", spied)
    model.learn(100, callback=callback)
    whole = sum(layer.size for layer in model.policy.sparse.layers)
    assert choices[0] == (whole, ())
    assert len(choices) > 2
    assert all(2 * b <= a for (a, _), (b, _) in zip(choices, choices[1:], strict=False))
    assert choices[1][1] != ()
    assert "critic.qf1.2" in compact_names(model)
