from __future__ import annotations

import json
import zipfile

import numpy as np
import pytest

from sb3_sparse.report import read_runs
from sb3_sparse.report.figures.curves import aligned
from sb3_sparse.report.normalisation import HUMAN, Normaliser
from sb3_sparse.report.results import Results


def reasons(folders):
    runs, out = read_runs(folders)
    return runs, {one.folder: one.reason for one in out}


def test_a_finished_run_is_read_with_its_score(folders):
    folder = folders.add(seed=3, score=[0.0] * 19 + [10.0])  # 20 evaluations: the last two count
    runs, out = reasons([folder])
    assert not out
    assert (runs[0].label, runs[0].level, runs[0].seed, runs[0].trained) == ("rigl", 0.9, 3, True)
    assert runs[0].score == 5.0
    assert runs[0].family == "DQN on classic control"


def test_a_smaller_dense_network_has_a_label_of_its_own(folders):
    folders.add("dense", None)
    folders.add("dense", None, match=0.9)
    runs, _ = read_runs(folders.made)
    assert [(run.label, run.level) for run in runs] == [("dense", 0.0), ("dense-equal", 0.9)]


def test_dense_networks_that_match_those_of_other_widths_are_other_variants(folders):
    for width in (256, 512):
        for seed in range(2):
            built = {"net_arch": [width // 10]}
            asked = {"net_arch": [width]}
            folders.add("dense", None, seed, match=0.9, policy=built, overrides=asked)
    runs, _ = read_runs(folders.made)
    assert len(runs) == 4
    assert len({run.variant() for run in runs}) == 2
    assert len({run.variant("net_arch") for run in runs}) == 1
    assert {run.asked.value("net_arch")[0] for run in runs} == {256, 512}


def test_simba_networks_are_compared_with_each_other(folders):
    folders.add(settings={"policy": "sb3_sparse.SparseSimbaPolicy"})
    folders.add(settings={"policy": "sb3_sparse.SparsePolicy"})
    runs, _ = read_runs(folders.made)
    families = [run.family for run in runs]
    assert families == ["DQN with SimBa on classic control", "DQN on classic control"]


def test_seconds_are_the_processors_or_on_a_gpu_those_that_passed(folders):
    on_cpu, on_gpu, old = folders.add(seed=0, seconds=5.0), folders.add(seed=1), folders.add(seed=2)
    changed(on_gpu, "seconds", wall=7.0, processor=9.0)
    path = on_gpu / "sparsity.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "device": "cuda"}))
    runs, _ = read_runs([on_cpu, on_gpu, old])
    assert [run.seconds for run in runs] == [5.0, 7.0, None]


def test_a_damaged_number_of_seconds_is_named(folders):
    folder = folders.add(seconds=-1.0)
    assert "damaged" in reasons([folder])[1][folder]


def changed(folder, part, **values):
    path = folder / "sparsity.json"
    record = json.loads(path.read_text())
    record[part] = {**record.get(part, {}), **values}
    path.write_text(json.dumps(record))


@pytest.mark.parametrize("status", ["finished", "counted"])
@pytest.mark.parametrize(
    ("nnz", "wanted", "read"),
    [(410, 410, True), (410, 408, True), (4096, 410, False), (500, 410, False), (300, 410, False)],
)
def test_a_run_that_is_not_as_sparse_as_it_was_to_be_is_named_and_not_averaged(
    folders, status, nnz, wanted, read
):
    folder = folders.add("prune", 0.9, status=status)
    changed(folder, "total", nnz=nnz, wanted_nnz=wanted, sparsity=1 - nnz / 4096)
    runs, out = reasons([folder])
    assert [bool(runs), bool(out)] == [read, not read]
    if not read:
        assert f"its sparsity is {1 - nnz / 4096:.2%}, not the 0.9" in out[folder]


def test_an_older_record_of_a_run_that_stayed_dense_is_named_too(folders):
    folder = folders.add("static", 0.9, policy={"initial_sparsity": 0.0})
    assert not reasons([folder])[1]
    changed(folder, "total", sparsity=0.0)
    assert "its sparsity is 0.00%, not the 0.9" in reasons([folder])[1][folder]


def test_a_run_that_diverged_is_named_with_its_step_and_never_averaged(folders):
    good, bad = folders.add("set", 0.9, 0), folders.add("set", 0.9, 1, status="diverged")
    path = bad / "sparsity.json"
    error = "training diverged: at step 600 there is NaN"
    path.write_text(json.dumps({**json.loads(path.read_text()), "error": error}))
    runs, (out,) = read_runs([good, bad])
    assert [run.folder for run in runs] == [good]
    assert (out.folder, out.diverged) == (bad, True)
    assert out.reason == f"DQN on CartPole-v1, set 90%, seed 1: {error}"


@pytest.mark.parametrize("status", ["running", "evaluating", "interrupted", "failed"])
def test_an_unfinished_run_is_named(folders, status):
    folder = folders.add(status=status)
    runs, out = reasons([folder])
    assert not runs
    assert ("failed" if status == "failed" else status) in out[folder]


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda f: (f / "sparsity.json").write_text('{"status": "fin'), "damaged"),
        (
            lambda f: (f / "sparsity.json").write_text("[]"),
            "is a list instead of a mapping",
        ),
        (lambda f: (f / "sparsity.json").write_bytes(b"\xff\xfe\x00"), "is not UTF-8 text"),
        (lambda f: (f / "sparsity.json").unlink(), "no run of sb3-sparse"),
        (lambda f: (f / "evaluations.npz").unlink(), "evaluations.npz is missing"),
        (lambda f: (f / "evaluations.npz").write_bytes(b"PK\x03\x04 half"), "damaged"),
        (lambda f: (f / "evaluations.npz").write_bytes(b""), "damaged"),
        (lambda f: np.savez(f / "evaluations.npz", timesteps=[1], results=[[np.nan]]), "finite"),
        (lambda f: np.savez(f / "evaluations.npz", timesteps=[1, 2], results=[[1.0]]), "damaged"),
        (lambda f: np.savez(f / "evaluations.npz", timesteps=[], results=[]), "damaged"),
    ],
)
def test_a_broken_folder_is_named_and_the_others_are_read(folders, spoil, said):
    good, bad = folders.add(seed=0), folders.add(seed=1)
    spoil(bad)
    runs, out = reasons([good, bad])
    assert [run.folder for run in runs] == [good]
    assert said in out[bad]


@pytest.mark.parametrize("part", ["total", "settings", "layers", "run"])
def test_a_record_that_lacks_a_part_is_named(folders, part):
    folder = folders.add()
    record = json.loads((folder / "sparsity.json").read_text())
    del record[part]
    (folder / "sparsity.json").write_text(json.dumps(record))
    _, out = reasons([folder])
    assert part in out[folder]


def test_a_missing_folder_is_named(tmp_path):
    _, out = reasons([tmp_path / "nowhere"])
    assert "no such folder" in out[tmp_path / "nowhere"]


def test_a_duplicate_is_named_but_another_seed_is_not(folders):
    first, again, other = folders.add(seed=0), folders.add(seed=0), folders.add(seed=1)
    runs, out = reasons(folders.made)
    assert [run.folder for run in runs] == [first, other]
    assert str(first) in out[again]


def test_a_damaged_measurement_is_named_and_the_run_stays(folders):
    folder = folders.add()
    (folder / "snr.csv").write_text("timesteps,name,value\n100,snr/q_net,abc\n")
    runs, out = reasons([folder])
    assert len(runs) == 1
    assert "snr.csv" not in runs[0].measured
    assert "line 2" in out[folder]


def test_curves_of_other_steps_are_named_and_not_averaged(folders):
    for seed, evaluations in enumerate((10, 10, 7)):
        folders.add(seed=seed, score=float(seed), evaluations=evaluations)
    runs, out = read_runs(folders.made)
    assert not out
    steps, values, remarks = aligned(runs)
    assert (len(steps), values.shape) == (10, (2, 10))
    assert str(folders.made[2]) in remarks[0]
    assert runs[2].score == 2.0


def test_no_two_settings_are_averaged_and_the_least_changed_compares(folders):
    for seed in range(2):
        folders.add(seed=seed, score=100.0)
    for seed in range(3):
        folders.add(
            seed=seed, score=0.0, policy={"weight_decay": 0.1}, overrides={"weight_decay": 0.1}
        )
    results = Results(tuple(read_runs(folders.made)[0]))
    cell = results.cell("DQN on classic control", "CartPole-v1", "rigl", 0.9)
    assert [run.score for run in cell] == [100.0, 100.0]
    assert "2 variants" in results.remarks[0]


# DQN's scores and percentages of the human tester, of the same table of Mnih et al. 2015: an
# independent check of each pair.
DQN = {
    "Assault": (3359, 246.2), "Asterix": (6012, 69.96), "BeamRider": (6846, 119.8),
    "Boxing": (71.8, 1707.9), "Breakout": (401.2, 1327.2), "CrazyClimber": (114103, 419.5),
    "DemonAttack": (9711, 294.2), "Enduro": (301.8, 97.47), "FishingDerby": (-0.8, 93.52),
    "MsPacman": (2311, 13.02), "Pong": (18.9, 132.0), "Qbert": (10596, 78.49),
    "SpaceInvaders": (1976, 121.5), "Tutankham": (186.7, 112.2), "VideoPinball": (42684, 2539.4),
}  # fmt: skip


@pytest.mark.parametrize("env_id", ["ALE/{}-v5", "{}NoFrameskip-v4"])
def test_the_human_scale_gives_the_published_percentages_of_dqn(folders, env_id):
    assert set(DQN) == set(HUMAN)
    for game, (score, _) in DQN.items():
        folders.add(env_id=env_id.format(game), score=float(score))
    runs, _ = read_runs(folders.made)
    normaliser = Normaliser(runs)
    for run, (game, (_, percentage)) in zip(runs, DQN.items(), strict=True):
        assert 100 * normaliser(run) == pytest.approx(percentage, rel=1e-3), game


def test_mujoco_is_divided_by_the_mean_of_the_same_algorithms_dense_runs(folders):
    for seed, score in enumerate((900.0, 1100.0)):
        folders.add("dense", None, seed, score, env_id="Hopper-v5", algo="sac")
    folders.add("dense", None, 0, 5.0, env_id="Hopper-v5", algo="ppo")
    folders.add("dense", None, 0, 5.0, match=0.9, env_id="Hopper-v5", algo="sac")
    folders.add("rigl", 0.9, 0, 1500.0, env_id="Hopper-v5", algo="sac")
    runs, _ = read_runs(folders.made)
    normaliser = Normaliser(runs)
    assert normaliser(runs[-1]) == 1.5
    assert any("the mean of 2 dense runs of full size" in text for text in normaliser.statements())


def test_a_task_without_a_scale_is_named(folders):
    folders.add("rigl", 0.9, 0, 1500.0, env_id="Hopper-v5", algo="sac")
    folders.add("dense", None, 0, -5.0, env_id="Reacher-v5", algo="sac")
    runs, _ = read_runs(folders.made)
    normaliser = Normaliser(runs)
    assert normaliser(runs[0]) is None
    assert "no run of the dense network" in normaliser.missing[0]
    assert "-5" in normaliser.missing[1]


def test_returns_that_are_given_fix_the_scale_of_a_task_before_all_others(folders):
    folders.add("rigl", 0.9, 0, -300.0, env_id="Maze-v0")
    folders.add("dense", None, 0, -200.0, env_id="Maze-v0")
    folders.add("rigl", 0.9, 0, 150.0, env_id="CartPole-v1")
    runs, _ = read_runs(folders.made)
    normaliser = Normaliser(runs, {"Maze-v0": (-500.0, -100.0), "CartPole-v1": (50.0, 250.0)})
    assert [normaliser(run) for run in runs] == [0.5, 0.75, 0.5]
    assert not normaliser.missing
    assert any(
        "Maze-v0: 0 stands for a score of -500, 1 for -100 (reference_returns" in text
        for text in normaliser.statements()
    )


def test_a_damaged_model_is_named_by_the_figure_of_masks(folders):
    from sb3_sparse.report.figures import NotEnoughData, draw

    folder = folders.add()
    with zipfile.ZipFile(folder / "CartPole-v1.zip", "w") as file:
        file.writestr("policy.pth", b"nothing")
    with pytest.raises(NotEnoughData, match="cannot be read"):
        draw("masks", Results(tuple(read_runs([folder])[0])))
