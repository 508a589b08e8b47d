"""Runs with a method for each network, and presets."""

from __future__ import annotations

import json

import pytest
import yaml
from rl_zoo3.utils import get_callback_list
from stable_baselines3 import SAC
from study_support import study
from tuning_support import small_run

from sb3_sparse.errors import ConfigError
from sb3_sparse.report.methods import name_of
from sb3_sparse.topology import Methods
from sb3_sparse.tuning.definition import Definition
from sb3_sparse.tuning.shipped import paper_space, wide_space
from sb3_sparse.tuning.spaces import Space
from sb3_sparse.zoo import train
from sb3_sparse.zoo.callbacks import CALLBACK
from sb3_sparse.zoo.configs import config_path, read_yaml
from sb3_sparse.zoo.settings import Settings
from sb3_sparse.zoo.spec import RunSpec

MST = {"actor": "static", "critic": "rigl"}
LABEL = "critic=rigl"
QUICK = {"n_timesteps": 200, "eval_freq": 100, "eval_episodes": 1}
SMALL = {"learning_starts": 50, "net_arch": [8], "batch_size": 16, "buffer_size": 500}


def pendulum(**changes):
    return RunSpec(**{"algo": "sac", "env_id": "Pendulum-v1", **changes})


def callback_of(settings):
    return settings["callback"][0][CALLBACK]


@pytest.mark.parametrize(
    "method",
    [MST, LABEL, {"critic": "rigl"}, "actor=static,critic=rigl", "critic=rigl , actor=static"],
)
def test_methods_by_network_are_named_in_one_way(method):
    run = pendulum(method=method)
    assert run.method == LABEL
    assert run.preset is None
    assert run.settings().method == LABEL
    assert RunSpec(**json.loads(json.dumps(run.as_dict()))) == run


def test_settings_are_those_of_the_first_method_that_moves():
    settings = pendulum(method=MST, sparsity=0.8).settings()
    rigl = pendulum(method="rigl", sparsity=0.8).settings()
    assert callback_of(settings) == {**callback_of(rigl), "method": {"critic": "rigl"}}
    assert settings.policy_kwargs == rigl.policy_kwargs
    without = {name: value for name, value in settings.items() if name != "callback"}
    assert without == {name: value for name, value in rigl.items() if name != "callback"}


def test_networks_start_as_their_methods_usually_do():
    mixed = pendulum(method={"actor": "prune", "critic": "granet"}, sparsity=0.8).settings()
    assert mixed.policy_kwargs["initial_sparsity"] == {"actor": 0.0, "critic": 0.4}
    assert callback_of(mixed)["update_interval"] == 1000  # as prune/sac.yml has it
    half = pendulum(method={"critic": "prune"}, sparsity=0.8).settings()
    assert half.policy_kwargs["initial_sparsity"] == {"critic": 0.0}
    still = pendulum(method={"actor": "static", "critic": "static"}).settings()
    assert still == pendulum(method="static").settings()


def test_a_network_that_the_policy_lacks_is_named_before_anything_is_trained():
    with pytest.raises(ConfigError, match="no network 'critics'.*'actor', 'critic'"):
        pendulum(method={"critics": "rigl"}).settings()
    with pytest.raises(ConfigError, match="initial_sparsity is given for 'critics'"):
        pendulum(hyperparams={"initial_sparsity": {"critics": 0.1}}).settings()


def test_a_method_of_ones_own_leads_to_the_config_of_a_shipped_one():
    mixed = pendulum(method={"actor": "least-index", "critic": "set"})
    assert mixed.config == config_path("set", "sac")
    own = pendulum(method={"critic": "least-index"})
    assert own.config == config_path("static", "sac")
    assert callback_of(own.settings()) == {"method": {"critic": "least-index"}}


def test_options_by_network_are_merged_into_known_ones():
    run = pendulum(method="rigl", hyperparams={"update_interval": {"actor": 2000, "critic": 500}})
    changed = run.settings().changed({"update_interval": {"critic": 7}}, SAC)
    assert changed.callback["update_interval"] == {"actor": 2000, "critic": 7}
    assert run.settings().changed({"update_interval": 9}, SAC).callback["update_interval"] == 9


def test_a_search_shares_no_more_out_than_a_network_starts_with():
    sizes = {"actor": 100, "critic": 300}  # of 400, 200 stay at the end

    def bounds(method):
        found = wide_space(method, sizes, 0.5).distributions["actor_share"]
        return found.low, found.high

    # GraNet starts at 0.25, i.e. with 75 and 225; the end is the actor's share of 200.
    assert bounds("granet") == pytest.approx((0.05, 0.375), abs=2e-4)
    assert bounds("actor=granet") == pytest.approx((0.05, 0.375), abs=2e-4)
    for method in ("critic=granet", "rigl", "prune"):
        assert bounds(method) == pytest.approx((0.05, 0.5), abs=2e-4)
    # Of 300 and 100, 200 stay, and critics that start at 0.25 have 75 at most: 0.625 or more.
    sizes = {"actor": 300, "critic": 100}
    assert "actor_share" not in wide_space("critic=granet", sizes, 0.5).distributions


def test_an_entry_given_for_a_preset_is_of_its_kind():
    other = pendulum(method="set").config_entry()
    for preset in ("rlx2", "mst", "simba"):
        with pytest.raises(
            ConfigError, match=f"with method 'set', which is not the preset '{preset}'"
        ):
            pendulum(method=preset, entry=other).settings()
    rlx2 = pendulum(method="rlx2").config_entry()
    with pytest.raises(ConfigError, match="'rigl' and the callbacks RobustValueCallback, which is"):
        pendulum(method="mst", entry=rlx2).settings()
    assert pendulum(method="rlx2", entry=rlx2).settings().method == "rigl"


def test_a_file_of_ones_own_may_name_methods_by_network(tmp_path):
    entry = read_yaml(config_path("mst", "sac"))["Pendulum-v1"]
    path = tmp_path / "mine.yml"
    path.write_text(yaml.safe_dump({"Pendulum-v1": entry}))
    for method in (None, MST, {"critic": "rigl"}):
        settings = pendulum(conf_file=str(path), method=method).settings()
        assert settings.method == LABEL
        assert settings == pendulum(method="mst").settings()
    for method in ("mst", "rigl", {"critic": "set"}):
        with pytest.raises(ConfigError, match=f"trains with method '{LABEL}', not"):
            pendulum(conf_file=str(path), method=method).settings()


def test_half_the_sparsity_follows_the_sparsity_and_another_start_stays():
    for sparsity, start in ((None, 0.45), (0.9, 0.45), (0.8, 0.4), (0.3, 0.15)):
        settings = pendulum(method="granet", sparsity=sparsity).settings()
        assert settings.policy_kwargs["initial_sparsity"] == start
    own = pendulum(method="granet", sparsity=0.8, hyperparams={"initial_sparsity": 0.2})
    assert own.settings().policy_kwargs["initial_sparsity"] == 0.2
    kwargs = {"sparsity": 0.9, "initial_sparsity": 0.2}
    content = {"policy": "SparsePolicy", "policy_kwargs": kwargs}
    content["callback"] = {CALLBACK: {"method": "granet"}}
    kept = Settings(content).changed({"sparsity": 0.5}, SAC)
    assert kept.policy_kwargs["initial_sparsity"] == 0.2
    by_network = {"sparsity": {"actor": 0.9, "critic": 0.6}}
    settings = pendulum(method="granet", hyperparams=by_network).settings()
    assert settings.policy_kwargs["initial_sparsity"] == {"actor": 0.45, "critic": 0.3}
    pruned = pendulum(method="prune", hyperparams=by_network).settings()
    assert pruned.policy_kwargs["initial_sparsity"] == 0.0


def test_a_preset_is_a_folder_and_gives_its_name_to_the_run(tmp_path):
    run = pendulum(method="mst", hyperparams={**SMALL, "update_interval": 20}, **QUICK)
    assert run.preset == "mst"
    assert run.config == config_path("mst", "sac")
    assert run.settings().method == LABEL
    assert RunSpec(**{**run.as_dict(), "entry": run.config_entry()}).settings() == run.settings()
    outcome = train(run, tmp_path)
    record = json.loads((outcome.folder / "sparsity.json").read_text())
    assert (record["status"], record["method"], record["run"]["method"]) == (
        "finished", "mst", "mst",
    )  # fmt: skip
    assert name_of("mst") == "MST"
    actor, critic = outcome.model.policy.sparse.networks
    assert actor.mask_updates == 0
    assert critic.mask_updates > 2


def test_a_preset_without_a_config_of_the_algorithm_says_which_it_has():
    with pytest.raises(ConfigError, match="for 'ppo' with method 'mst', only for sac, td3"):
        pendulum(algo="ppo", method="mst").settings()


def test_a_study_takes_methods_by_network(tmp_path):
    one = study(
        tmp_path,
        common={"algo": "sac", "env_id": "Pendulum-v1"},
        runs=[{"method": ["rigl", MST, {"critic": "prune"}, "mst"], "sparsity": 0.5}],
        scales={"smoke": {"method": ["rigl", MST, "mst"], "schedule": {"update_interval": 7}}},
    )
    assert [cell.run.method for cell in one.cells] == ["rigl", LABEL, "mst"]
    assert len({cell.address for cell in one.cells}) == 3
    for cell in one.cells:
        assert callback_of(cell.run.settings())["update_interval"] == 7
    assert one.cells[1].name == (f"sac Pendulum-v1 {LABEL} 50%, update_interval 7, seed 0")


def test_a_search_has_the_options_of_all_methods():
    run = small_run(algo="sac", env_id="Pendulum-v1", method=MST, hyperparams={})
    space = paper_space(run.settings().method)
    assert space.grid.keys() == {
        "weight_decay", "update_interval", "drop_fraction", "sparsity_aware_init",
    }  # fmt: skip
    Definition(run, space, 1, "grid", "none")
    assert "drop_fraction" not in paper_space("actor=static, critic=prune").distributions
    assert "sparsity_aware_init" in paper_space("actor=static, critic=prune").distributions
    assert "sparsity_aware_init" in paper_space("granet").distributions
    wide = wide_space(LABEL, {"actor": 696, "critic": 1392}, 0.9)
    assert {"update_interval", "drop_fraction", "actor_share"} <= wide.distributions.keys()
    still = small_run(algo="sac", env_id="Pendulum-v1", method={"critic": "prune"})
    with pytest.raises(ConfigError, match="'critic=prune' has no drop_fraction"):
        Definition(still, Space("mine", paper_space("rigl").distributions), 1, "grid", "none")


def test_a_search_of_a_preset_is_named_after_it():
    run = small_run(algo="sac", env_id="Pendulum-v1", method="mst", hyperparams={})
    definition = Definition(run, paper_space(run.settings().method), 1, "grid", "none")
    assert definition.method == "mst"
    assert definition.default_name == "sac_Pendulum-v1_mst_0.6_paper"


def test_rl_zoo_makes_the_callback_of_a_mapping():
    entry = read_yaml(config_path("mst", "sac"))["Pendulum-v1"]
    (callback,) = get_callback_list(entry)
    assert callback.plans["critic"].method == "rigl"
    assert callback.plans["actor"].method == "static"
    assert Methods.of(callback_of(entry)["method"]).label == LABEL
