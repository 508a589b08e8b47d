"""Studies as they stand in their files."""

from __future__ import annotations

import pytest
import yaml

from sb3_sparse.errors import ConfigError
from sb3_sparse.studies import Study, study_names
from sb3_sparse.studies.blocks import SCALES, planned_runs

MINIMAL = {
    "title": "A title",
    "figures": ["iqm"],
    "common": {"algo": "dqn", "env_id": ["CartPole-v1", "Acrobot-v1"]},
    "runs": [
        {"method": "dense"},
        {"method": ["set", "rigl"], "sparsity": [0.5, 0.9]},
    ],
    "scales": {"smoke": {"seeds": 2, "n_timesteps": 100}},
}


def read(tmp_path, **changed):
    path = tmp_path / "mine.yml"
    path.write_text(yaml.safe_dump({**MINIMAL, **changed}))
    return Study.read(str(path), "smoke")


def test_every_combination_of_the_lists_is_a_cell_once_a_seed(tmp_path):
    study = read(tmp_path)
    assert len(study.cells) == 2 * 2 * (1 + 2 * 2)  # seeds, environments, dense and four sparse
    runs = [cell.run for cell in study.cells]
    assert len({(r.env_id, r.method, r.sparsity, r.seed) for r in runs}) == 20
    assert {r.n_timesteps for r in runs} == {100}


def test_reference_returns_are_pairs_by_environment(tmp_path):
    assert read(tmp_path).references == {}
    given = {"Acrobot-v1": [-500, -80], "my_envs:Maze-v0": [0, 1.5]}
    study = read(tmp_path, reference_returns=given)
    assert study.references == {"Acrobot-v1": (-500.0, -80.0), "Maze-v0": (0.0, 1.5)}
    assert [one.address for one in study.cells] == [one.address for one in read(tmp_path).cells]


@pytest.mark.parametrize(
    "given",
    [[-500, -80], {"Maze-v0": -80}, {"Maze-v0": [-80, -500]}, {"Maze-v0": [0, float("inf")]}],
)
def test_reference_returns_that_are_no_scale_are_rejected(tmp_path, given):
    with pytest.raises(ConfigError, match=r"reference_returns .*must .*got"):
        read(tmp_path, reference_returns=given)


def test_first_seeds_come_first(tmp_path):
    seeds = [cell.run.seed for cell in read(tmp_path).cells]
    assert seeds == sorted(seeds)


def test_the_same_cell_has_the_same_address_in_every_study(tmp_path):
    other = read(tmp_path, title="Another", runs=[{"method": "rigl", "sparsity": 0.9}])
    theirs = {cell.address for cell in other.cells}
    assert len(theirs) == 4
    assert theirs < {cell.address for cell in read(tmp_path).cells}


def test_a_setting_that_the_config_has_anyway_changes_no_address(tmp_path):
    plain = read(tmp_path, runs=[{"method": "rigl", "sparsity": 0.9}])
    said = read(
        tmp_path,
        runs=[{"method": "rigl", "sparsity": 0.9, "hyperparams": {"update_interval": 1000}}],
    )
    assert [cell.address for cell in plain.cells] == [cell.address for cell in said.cells]


@pytest.mark.parametrize(
    "changed",
    [
        {"scales": {"smoke": {"seeds": 2, "n_timesteps": 101}}},
        {"measures": {"snr": {"every": 50}}},
        {"trained": False},
        {"common": {**MINIMAL["common"], "hyperparams": {"gamma": 0.9}}},
    ],
)
def test_what_decides_the_outcome_changes_every_address(tmp_path, changed):
    one = {cell.address for cell in read(tmp_path).cells}
    assert one.isdisjoint(cell.address for cell in read(tmp_path, **changed).cells)


def test_what_is_measured_of_the_trained_model_is_no_part_of_the_address(tmp_path):
    noisy = read(tmp_path, measures={"noise": {"sigmas": [0, 1]}})
    assert [c.address for c in noisy.cells] == [c.address for c in read(tmp_path).cells]


def test_what_varies_is_a_hyperparameter_of_each_run(tmp_path):
    study = read(tmp_path, runs=[{"method": "dense", "vary": {"weight_decay": [0.0, 1e-4]}}])
    decays = [cell.run.settings()["policy_kwargs"]["weight_decay"] for cell in study.cells]
    assert sorted(set(decays)) == [0.0, 1e-4]
    assert len(study.cells) == 2 * 2 * 2


def test_a_scale_leaves_out_sparsities_methods_and_environments(tmp_path):
    scales = {"smoke": {"sparsity": [0.9], "method": ["dense", "rigl"], "env_id": ["CartPole-v1"]}}
    runs = [cell.run for cell in read(tmp_path, scales=scales).cells]
    assert [(r.env_id, r.method, r.sparsity) for r in runs] == [
        ("CartPole-v1", "dense", None),
        ("CartPole-v1", "rigl", 0.9),
    ]


def test_a_scales_schedule_is_for_masks_that_move(tmp_path):
    scales = {"smoke": {"schedule": {"update_interval": 7}}}
    methods = [{"method": "dense"}, {"method": ["static", "set", "prune"], "sparsity": 0.5}]
    runs = [cell.run for cell in read(tmp_path, scales=scales, runs=methods).cells]
    still = [r for r in runs if r.method in ("dense", "static")]
    assert len(runs) == 2 * len(still) > 0
    assert all(r.hyperparams == {} for r in still)
    assert all(r.hyperparams == {"update_interval": 7} for r in runs if r not in still)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"runs": [{"method": "rigl", "sparsitty": 0.9}]}, "unknown keys sparsitty"),
        ({"colour": "red"}, "unknown keys colour"),
        ({"scales": {"small": {}}}, "has no scale 'smoke', only small"),
        ({"scales": {"smoke": {"seeds": 0}}}, "seeds must be a number, 1 or more, got 0"),
        ({"measures": {"temperature": {}}}, "unknown measure 'temperature'"),
        ({"measures": {"snr": {"often": 3}}}, "measure snr takes every"),
        ({"measures": {"snr": {"every": 0}}}, "every of measure snr must be a whole number"),
        ({"measures": {"noise": {"sigmas": 3}}}, "sigmas of measure noise must be a list"),
        ({"figures": "iqm"}, "figures must be a list of names, got 'iqm'"),
        ({"figures": []}, "figures must be a list of names, got []"),
        ({"figures": ["sensitivity"]}, "the figure sensitivity needs varies"),
        (
            {"common": {"algo": "a2c", "env_id": "CartPole-v1"}, "measures": {"snr": {"every": 9}}},
            "gradient_snr has no loss of A2C; supported are DQN, SAC, PPO",
        ),
        ({"trained": "no"}, "trained must be true or false, got 'no'"),
        ({"runs": {"method": "dense"}}, "runs must be a list of blocks"),
        ({"scales": {"smoke": {"n_timesteps": "4e3"}}}, "n_timesteps must be a whole number"),
        ({"scales": {"smoke": {"hyperparams": "gamma:0.9"}}}, "hyperparams must be a mapping"),
        ({"scales": {}}, "has no scale 'smoke', only {}"),
        ({"runs": []}, "has no run at scale smoke"),
        ({"runs": ["dense"]}, "a block of runs must be a mapping, got 'dense'"),
        ({"scales": {"smoke": 3}}, "a scale must be a mapping, got 3"),
        ({"scales": {"smoke": {"schedule": 3}}}, "schedule must be a mapping, got 3"),
        ({"runs": [{"method": "dense", "vary": {"gamma": 0.9}}]}, "vary must map"),
        ({"runs": [{"method": "dense", "vary": {"gama": [0.9]}}]}, "did you mean 'gamma'"),
        (
            {"runs": [{"method": "static", "sparsity": 0.5, "vary": {"update_interval": [5]}}]},
            "method 'static' has no update_interval",
        ),
        ({"runs": [{"method": "dense", "sparsity": 0.9}]}, "dense training has no sparsity"),
        ({"scales": {"smoke": {"method": "abc"}}}, "chooses method: 'abc', which no block has"),
        ({"scales": {"smoke": {"method": ["set", "rigel"]}}}, "did you mean 'rigl'"),
        (
            {"scales": {"smoke": {"sparsity": [0.9, 0.95]}}},
            "0.95, which no block has",
        ),
        ({"scales": {"smoke": {"match_params": [0.9]}}}, "match_params, which no block has"),
        ({"scales": {"smoke": {"distribution": "erk"}}}, "distribution, which no block has"),
        ({"scales": {"smoke": {"algo": "sac"}}}, "algo: 'sac', which no block has"),
        ({"scales": {"smoke": {"vary": {"gamma": [0.9]}}}}, "vary: gamma, which no block has"),
        (
            {"scales": {"smoke": {"schedule": {"update_intervall": 5}}}},
            "schedule has 'update_intervall', which no method takes (did you mean",
        ),
        ({"scales": {"smal": {}, "smok": {}}}, "no scale 'smoke' (did you mean 'smok'?), only"),
        ({"runs": [{"method": "dense", "vary": [3]}]}, "vary must map"),
        ({"varies": "batchsize"}, "got 'batchsize' (did you mean 'batch_size'?)"),
        ({"varies": ["gamma"]}, "varies must be the name of a setting"),
    ],
)
def test_mistakes_are_named_with_the_file(tmp_path, changed, said):
    with pytest.raises(ConfigError, match="mine.yml") as caught:
        read(tmp_path, **changed)
    assert said in str(caught.value)


def test_a_scale_chooses_among_single_values_as_among_lists(tmp_path):
    runs = [{"method": "rigl", "sparsity": 0.9}, {"method": "set", "sparsity": 0.5}]
    for choice in ("set", ["set"]):
        cells = read(tmp_path, runs=runs, scales={"smoke": {"method": choice}}).cells
        assert {cell.run.method for cell in cells} == {"set"}


def test_a_scale_chooses_among_varied_values(tmp_path):
    runs = [
        {"method": "dense", "vary": {"net_arch": [[4, 4], [8, 8]], "gamma": [0.9, 0.99]}},
        {"method": "rigl", "sparsity": 0.9, "vary": {"net_arch": [[5, 5], [6, 6]]}},
        {"method": "set", "sparsity": 0.9, "vary": {"net_arch": [[7, 7]]}},
        {"method": "static", "sparsity": 0.9},
    ]
    scales = {"smoke": {"env_id": "CartPole-v1", "vary": {"net_arch": [[8, 8], [5, 5]]}}}
    runs = [cell.run for cell in read(tmp_path, runs=runs, scales=scales).cells]
    assert [(run.method, dict(run.hyperparams)) for run in runs] == [
        ("dense", {"net_arch": [8, 8], "gamma": 0.9}),
        ("dense", {"net_arch": [8, 8], "gamma": 0.99}),
        ("rigl", {"net_arch": [5, 5]}),
        ("static", {}),
    ]
    one = [{"method": "dense", "vary": {"net_arch": [[8, 8]]}}]
    none = {"smoke": {"vary": {"net_arch": [[8, 9]]}}}
    with pytest.raises(ConfigError, match=r"chooses vary: net_arch: \[8, 9\], which no block has"):
        read(tmp_path, runs=one, scales=none)


def test_the_study_of_scaling_compares_plain_and_simba_networks_at_equal_parameters():
    for scale in ("smoke", "small", "medium", "paper"):
        cells = Study.read("scaling", scale).cells
        for simba in (False, True):
            runs = [one.run for one in cells if ("policy" in one.run.hyperparams) == simba]
            widths = {str(run.hyperparams["net_arch"]) for run in runs}
            found = {(run.method, run.sparsity, run.match_params) for run in runs}
            sparse = {sparsity for _, sparsity, _ in found} - {None}
            matched = {match for *_, match in found} - {None}
            assert matched
            assert matched <= sparse
            assert {method for method, sparsity, _ in found if sparsity} >= {"static"}
            seeds = {run.seed for run in runs}
            tasks = {run.env_id for run in runs}
            assert len(runs) == len(widths) * len(found) * len(seeds) * len(tasks)
            alias = "SparseSimbaPolicy" if simba else "SparsePolicy"
            assert {run.settings().alias for run in runs[:20]} == {alias}


def test_an_unknown_study_is_answered_with_the_nearest_and_all_names():
    with pytest.raises(ConfigError, match=r"'clasic_control' \(did you mean 'classic_control'\?\)"):
        Study.read("clasic_control", "small")
    with pytest.raises(ConfigError, match="classic_control"):
        Study.read("figure_7", "small")


def test_the_studies_that_are_shipped():
    assert set(study_names()) == {
        *("sac", "ppo", "dqn_cnn", "dqn_resnet", "classic_control"),
        *("parameters_sac", "parameters_ppo", "parameters_dqn"),
        *("actor_critic", "distribution", "weight_decay", "initialisation", "drop_fraction"),
        *("update_interval", "batch_size", "last_layer_dense", "snr", "noise", "flops"),
        *("robust_value", "scaling", "simba"),
    }


@pytest.mark.parametrize("name", study_names())
def test_every_shipped_study_has_the_runs_that_the_list_counts_at_every_scale(name):
    planned = planned_runs(name)
    assert set(planned) in (set(SCALES), set(SCALES) - {"medium"})
    for scale, runs in planned.items():
        study = Study.read(name, scale)
        assert study.cells
        assert study.title
        assert runs == len(study.cells) + len(study.merged), scale
    assert planned["smoke"] <= planned["paper"]


def test_the_papers_seeds_steps_and_evaluations_are_the_configs_own():
    study = Study.read("sac", "paper")
    assert {cell.run.seed for cell in study.cells} == set(range(10))
    for cell in study.cells[:20]:
        assert cell.run.settings()["n_timesteps"] == 1_000_000
        assert cell.run.evaluation() == {"eval_freq": 10_000, "eval_episodes": 30}


@pytest.mark.parametrize(
    ("name", "seeds", "steps", "tasks"),
    [
        ("classic_control", 10, 100_000, {"CartPole-v1", "Acrobot-v1"}),
        ("ppo", 10, 1_000_000, {"HalfCheetah-v5", "Hopper-v5", "Walker2d-v5"}),
        ("sac", 5, 300_000, {"HalfCheetah-v5", "Hopper-v5", "Walker2d-v5"}),
    ],
)
def test_medium_has_all_ways_at_two_sparsities_and_seeds_enough(name, seeds, steps, tasks):
    cells = Study.read(name, "medium").cells
    runs = [cell.run for cell in cells]
    assert [run.seed for run in runs] == sorted([run.seed for run in runs])
    assert {run.settings()["n_timesteps"] for run in runs} == {steps}
    found = {(r.method, r.sparsity or r.match_params) for r in runs}
    assert found == {("dense", None)} | {
        (method, sparsity)
        for method in ("dense", "static", "set", "rigl", "prune")
        for sparsity in (0.9, 0.95)
    }
    assert {run.env_id for run in runs} == tasks
    assert len(cells) == seeds * len(tasks) * 11


def test_some_studies_have_a_scale_medium():
    names = [name for name in study_names() if "medium" in planned_runs(name)]
    assert names == [
        *("classic_control", "distribution", "noise", "ppo", "robust_value", "sac", "scaling"),
        *("snr", "weight_decay"),
    ]
    assert set(SCALES) == {scale for name in study_names() for scale in planned_runs(name)}


@pytest.mark.parametrize(
    ("name", "shared"),
    [
        # Two tasks and ten seeds: dense, and ERK by SET and RigL at 90 and 95 %.
        ("distribution", 2 * 10 * (1 + 2 * 2)),
        ("weight_decay", 2 * 10 * (1 + 2)),  # the config's decay: dense, SET and RigL at 90 %
        ("noise", 2 * 10 * (1 + 1 + 2)),  # dense, dense of equal size, SET and RigL at 90 %
    ],
)
def test_studies_of_dqn_at_medium_share_the_cells_of_classic_control(name, shared):
    trained = {cell.address for cell in Study.read("classic_control", "medium").cells}
    cells = Study.read(name, "medium").cells
    assert sum(cell.address in trained for cell in cells) == shared


def test_dense_widths_of_the_actor_critic_study_keep_their_budget():
    """Weights of HalfCheetah's SAC (17 observations, 6 actions, two critics), counted by hand."""
    for cell in Study.read("actor_critic", "small").cells:
        arch = cell.run.hyperparams.get("net_arch")
        if arch is None:
            continue
        pi, qf = arch["pi"][0], arch["qf"][0]
        total = 17 * pi + pi * pi + 12 * pi + 2 * (23 * qf + qf * qf + qf)
        dense = 17 * 256 + 256 * 256 + 12 * 256 + 2 * (23 * 256 + 256 * 256 + 256)
        assert min(abs(total / dense - budget) for budget in (1.0, 0.2, 0.1)) < 0.01


def test_cells_that_stand_there_twice_are_trained_once_and_named(tmp_path, capsys):
    runs = [{"method": "dense"}, {"method": "dense", "hyperparams": {"gamma": 0.99}}]
    study = read(tmp_path, runs=runs)
    assert len(study.cells) == 2 * 2
    assert study.merged == tuple(cell.name for cell in study.cells)
    assert read(tmp_path).merged == ()
    from sb3_sparse.cli.study import status

    path = str(tmp_path / "mine.yml")
    read(tmp_path, runs=runs)
    status(path, "smoke", tmp_path / "store")
    said = capsys.readouterr().out
    assert f"listed more than once, but trained once: {study.merged[0]}; " in said
    assert not (tmp_path / "store").exists()
