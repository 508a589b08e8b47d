"""Overrides find their place, and wrong ones are refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from stable_baselines3 import DQN, PPO, SAC

from sb3_sparse.errors import ConfigError
from sb3_sparse.zoo.callbacks import CALLBACK
from sb3_sparse.zoo.overrides import parse_overrides
from sb3_sparse.zoo.settings import Settings
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.validation import check_settings


def base(**more):
    return {
        "policy": "sb3_sparse.SparsePolicy",
        "learning_rate": 0.1,
        "policy_kwargs": {"sparsity": 0.9, "net_arch": [4]},
        "callback": [{CALLBACK: {"method": "rigl", "update_interval": 7}}],
        **more,
    }


def test_each_name_finds_its_own_place():
    settings = base()
    overrides = {
        "learning_rate": 0.2,
        "n_envs": 3,
        "weight_decay": 1e-4,
        "net_arch": [8, 8],
        "update_interval": 9,
        "drop_fraction": 0.1,
    }
    assert Settings(settings).changed(overrides, SAC) == {
        "policy": "sb3_sparse.SparsePolicy",
        "learning_rate": 0.2,
        "n_envs": 3,
        "policy_kwargs": {"sparsity": 0.9, "net_arch": [8, 8], "weight_decay": 1e-4},
        "callback": [{CALLBACK: {"method": "rigl", "update_interval": 9, "drop_fraction": 0.1}}],
    }
    assert settings == base()


def test_policy_kwargs_are_merged_so_that_the_sparsity_is_not_lost():
    settings = Settings(base()).changed({"policy_kwargs": {"net_arch": [2]}}, DQN)
    assert settings["policy_kwargs"] == {"sparsity": 0.9, "net_arch": [2]}


def test_arguments_of_every_base_class_count():
    overrides = {"ortho_init": False, "clip_range": 0.1, "n_critics": 3}
    settings = Settings(base()).changed({"n_critics": 3}, SAC)
    assert settings["policy_kwargs"]["n_critics"] == 3
    with pytest.raises(ConfigError, match="PPO has no hyperparameter 'n_critics'"):
        Settings(base()).changed(overrides, PPO)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("learning_rat", r"did you mean 'learning_rate'\?"),
        ("update_intervall", r"did you mean 'update_interval'\?"),
        ("env", "has no hyperparameter 'env'"),
        ("seed", "has no hyperparameter 'seed'"),
        ("method", "has no hyperparameter 'method'"),
        ("observation_space", "has no hyperparameter"),
        ("xyzzy", r"Of the algorithm: .*tau.* Of the policy: .*sparsity.* schedule: .*update_on"),
    ],
)
def test_unknown_names_are_refused(name, message):
    with pytest.raises(ConfigError, match=message):
        Settings(base()).changed({name: 1}, SAC)


def test_a_schedule_without_a_callback_is_refused():
    with pytest.raises(ConfigError, match="update_interval means nothing here"):
        RunSpec(method="dense", hyperparams={"update_interval": 5}).settings()


def test_texts_are_read_as_the_zoo_writes_them():
    texts = [
        "learning_rate:0.001",
        "train_freq:(1, 'episode')",
        "clip_range:lin_0.2",
        "use_sde:True",
        "policy_kwargs:dict(net_arch=dict(pi=[8], qf=[9]), n_critics=1)",
        "env_wrapper:sb3_sparse.wrappers.PixelNoise",
        "noise_type:'normal'",
    ]
    assert parse_overrides(texts) == {
        "learning_rate": 0.001,
        "train_freq": (1, "episode"),
        "clip_range": "lin_0.2",
        "use_sde": True,
        "policy_kwargs": {"net_arch": {"pi": [8], "qf": [9]}, "n_critics": 1},
        "env_wrapper": "sb3_sparse.wrappers.PixelNoise",
        "noise_type": "normal",
    }


def test_texts_are_not_executed():
    assert parse_overrides(["a:__import__('os')"]) == {"a": "__import__('os')"}


@pytest.mark.parametrize("text", ["learning_rate", "learning_rate:", ":1", "=1"])
def test_a_text_without_name_or_value_is_refused(text):
    with pytest.raises(ConfigError, match="name:value"):
        parse_overrides([text])


@pytest.mark.parametrize(
    ("policy", "alias"),
    [
        ("sb3_sparse.SparsePolicy", "SparsePolicy"),
        ("SparsePolicy", "SparsePolicy"),
        ("sb3_sparse.SparseSimbaPolicy", "SparseSimbaPolicy"),
        ("SparseSimbaPolicy", "SparseSimbaPolicy"),
    ],
)
def test_a_policy_goes_by_its_path_or_its_alias(policy, alias):
    settings = Settings(base(policy=policy))
    assert settings.alias == alias
    assert settings.policy_class(SAC) is SAC.policy_aliases[alias]
    assert settings.method == "rigl"


@pytest.mark.parametrize("policy", ["MlpPolicy", "sb3_sparse.SparseMlpPolicy", None, ["a"]])
def test_a_policy_that_is_not_sparse_is_refused(policy):
    with pytest.raises(ConfigError, match=r"SparsePolicy or sb3_sparse\.SparseSimbaPolicy .with"):
        Settings(base(policy=policy)).alias  # noqa: B018


def test_another_policy_is_a_setting_like_any_other():
    overrides = {"policy": "sb3_sparse.SparseSimbaPolicy", "net_arch": [8, 8], "n_critics": 1}
    settings = Settings(base()).changed(overrides, SAC)
    assert settings.alias == "SparseSimbaPolicy"
    assert settings.policy_kwargs == {"sparsity": 0.9, "net_arch": [8, 8], "n_critics": 1}


def test_an_algorithm_without_a_policy_names_those_that_have_it():
    run = RunSpec(
        algo="crossq",
        env_id="Pendulum-v1",
        hyperparams={"policy": "sb3_sparse.SparseSimbaPolicy"},
    )
    with pytest.raises(ConfigError, match="CrossQ has no SparseSimbaPolicy; it is there for DQN"):
        run.settings()


def test_the_method_is_read_off_the_callback_or_the_sparsity():
    assert Settings(base()).method == "rigl"
    assert Settings(base(callback=None)).method == "static"
    dense = base(policy_kwargs={"sparsity": 0.0})
    dense.pop("callback")
    assert Settings(dense).method == "dense"
    with pytest.raises(ConfigError, match="unknown method 'rig'"):
        Settings(base(callback=[{CALLBACK: {"method": "rig"}}])).method  # noqa: B018


def test_what_the_user_wants_wins_over_the_config():
    run = RunSpec(
        algo="sac",
        env_id="Ant-v5",
        method="set",
        sparsity=0.5,
        distribution="uniform",
        n_timesteps=77,
        n_envs=2,
        hyperparams={"sparsity_aware_init": False},
    )
    settings = run.settings()
    assert settings["n_timesteps"] == 77
    assert settings["n_envs"] == 2
    assert settings["policy_kwargs"]["sparsity"] == 0.5
    assert settings["policy_kwargs"]["distribution"] == "uniform"
    assert settings["policy_kwargs"]["sparsity_aware_init"] is False
    assert settings["learning_starts"] == 10_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(algo="reinforce"), "unknown algorithm 'reinforce'; allowed are"),
        (dict(env_id="CartPol-v1"), r"did you mean 'CartPole-v1'\?"),
        (dict(env_id="Zzzzzzz"), "give a Gymnasium id"),
        (dict(method="gmp"), "no config is shipped for method 'gmp'"),
        (dict(sparsity=1.0), r"sparsity must lie in \[0, 1\)"),
        (dict(distribution="erdos"), "distribution"),
        (dict(algo="SAC"), r"unknown algorithm 'SAC' \(did you mean 'sac'\?\)"),
        (dict(method="rigel"), r"did you mean 'rigl'\?"),
        (dict(conf_file="dqn_impla"), r"did you mean 'dqn_impala'\?"),
        (dict(sparsity=0.5, distribution="erkk"), r"did you mean 'erk'\?"),
        (dict(seed=-1), "seed must lie in"),
        (dict(seed="3"), "seed must be a whole number, e.g. 100000, got '3'"),
        (dict(seed=True), "seed must be a whole number, e.g. 100000, got True"),
        (dict(algo=3), "algo must be a text, got 3"),
        (dict(env_id=None), "env_id must be a text, got None"),
        (dict(conf_file="no/such"), "there is no config file no/such"),
        (dict(conf_file="/"), "/ is a folder; give a YAML file in it"),
        (dict(conf_file=3), "conf_file must be a text, got 3"),
        (dict(hyperparams=[]), r"hyperparams must be a mapping of names to values, got \[\]"),
        (dict(n_timesteps=1e4), "n_timesteps must be a whole number, e.g. 100000, got 10000.0"),
        (dict(n_timesteps=0), "n_timesteps must be 1 or more"),
        (dict(eval_freq=-5), "eval_freq must be 1 or more"),
        (dict(method="dense", sparsity=0.9), "--match-params 0.9"),
        (dict(method="rigl", match_params=0.9), "'rigl' is not dense; give --method dense"),
        (dict(method="dense", match_params=1.5), "match_params"),
    ],
)
def test_wrong_runs_are_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        RunSpec(**arguments).settings()


@pytest.mark.parametrize(
    "run",
    [
        RunSpec(method="dense", hyperparams={"sparsity": 0.5}),
        RunSpec(method="dense", match_params=0.9, hyperparams={"policy_kwargs": {"sparsity": 0.5}}),
        RunSpec(method="rigl", hyperparams={"callback": None}),
    ],
)
def test_overrides_cannot_turn_a_method_into_another(run):
    with pytest.raises(ConfigError, match=r"make this 'static' training, not '(dense|rigl)'"):
        run.settings()


def test_the_callback_is_known_by_any_path():
    path = "sb3_sparse.callback.SparsityCallback"
    callbacks = [{path: {"method": "set"}}, "os.path.join", {"no.such.Thing": {}}]
    assert Settings(base(callback=callbacks)).method == "set"
    settings = Settings(base(callback=callbacks)).changed({"update_interval": 3}, SAC)
    assert settings["callback"][0] == {path: {"method": "set", "update_interval": 3}}


@pytest.mark.parametrize("value", ["1e-3", "fast", "lin_", "lin_x"])
def test_a_learning_rate_that_is_text_is_explained(value):
    with pytest.raises(ConfigError, match=r"!!float 1e-3|lin_ and a number"):
        RunSpec(hyperparams={"learning_rate": value}).settings()


def test_a_file_of_ones_own_decides_the_method(tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text(
        "default:\n  policy: SparsePolicy\n  n_timesteps: !!float 1e3\n"
        '  policy_kwargs: "dict(sparsity=0.5, net_arch=[8])"\n'
    )
    settings = RunSpec(conf_file=str(path)).settings()
    assert settings.method == "static"
    assert settings["policy_kwargs"] == {"sparsity": 0.5, "net_arch": [8]}
    assert type(settings["n_timesteps"]) is int
    with pytest.raises(ConfigError, match="trains with method 'static', not 'rigl'"):
        RunSpec(conf_file=str(path), method="rigl").settings()


def test_a_shipped_file_can_be_named():
    run = RunSpec(env_id="PongNoFrameskip-v4", conf_file="dqn_impala", method="prune")
    assert run.config.name == "dqn_impala.yml"
    assert run.config.parent.name == "prune"


def test_a_run_survives_being_written_down():
    run = RunSpec(algo="ppo", env_id="Ant-v4", hyperparams={"gamma": 0.9}, eval_episodes=3)
    assert RunSpec(**run.as_dict()) == run
    assert run.evaluation() == {"eval_freq": 2000, "eval_episodes": 3}


def test_numpys_numbers_are_pythons_in_the_settings_and_on_record():
    given = dict(
        seed=np.int64(3),
        n_timesteps=np.int32(100),
        sparsity=np.float32(0.5),
        hyperparams={"gamma": np.float64(0.9), "net_arch": [np.int64(8)], "batch_size": np.int8(4)},
    )
    run = RunSpec(**given)
    assert run == RunSpec(
        seed=3,
        n_timesteps=100,
        sparsity=0.5,
        hyperparams={"gamma": 0.9, "net_arch": [8], "batch_size": 4},
    )
    assert RunSpec(**json.loads(json.dumps(run.as_dict()))) == run
    assert json.loads(json.dumps(run.settings().as_dict())) == run.settings()


def test_settings_from_a_strangers_file_import_nothing(tmp_path, monkeypatch):
    (tmp_path / "strange.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    settings = base(callback=["strange.Thing", {"strange.Callback": {"method": "set"}}])
    assert Settings(settings, imports=False).callback == {"method": "set"}
    assert Settings(settings, imports=False).method == "set"
    with pytest.raises(SystemExit, match="imported"):
        Settings(settings).callback  # noqa: B018


def test_settings_keep_what_they_were_made_of():
    content = base()
    settings = Settings(content)
    content["policy_kwargs"]["sparsity"] = 0.1
    settings.policy_kwargs["sparsity"] = 0.2
    settings.as_dict()["policy_kwargs"]["sparsity"] = 0.3
    settings["policy_kwargs"]["sparsity"] = 0.4
    settings.callback["update_interval"] = 8
    assert settings.callback["update_interval"] == 7
    assert settings["policy_kwargs"]["sparsity"] == 0.9
    assert settings.replaced(learning_rate=0.3)["learning_rate"] == 0.3
    assert settings["learning_rate"] == 0.1


def test_a_setting_is_found_wherever_it_lies():
    settings = Settings(base())
    names = ("sparsity", "update_interval", "learning_rate", "weight_decay", "distribution", "tau")
    assert [settings.value(name, SAC) for name in names] == [0.9, 7, 0.1, 0.0, "erk", 0.005]
    assert settings.value("drop_fraction", SAC) == "default"


ROBUST = "sb3_sparse.RobustValueCallback"
RLX2 = {
    "policy": "sb3_sparse.SparsePolicy",
    "policy_kwargs": {"sparsity": 0.9},
    "callback": [{CALLBACK: {"method": "rigl"}}, {ROBUST: {"multi_step": 3}}],
}


@pytest.mark.parametrize("form", [ROBUST, {ROBUST: None}, {ROBUST: {}}], ids=str)
@pytest.mark.parametrize("alone", [True, False])
def test_arguments_of_the_robust_value_callback_find_their_place(form, alone):
    callbacks = form if alone else [{CALLBACK: {"method": "rigl"}}, form]
    settings = Settings({**RLX2, "callback": callbacks})
    assert settings.robust_value == {}
    others = {} if alone else {"update_interval": 7}
    changed = settings.changed({"min_buffer_size": 50, **others}, SAC)
    assert changed.robust_value == {"min_buffer_size": 50}
    assert changed.value("min_buffer_size") == 50
    assert changed.callback == (None if alone else {"method": "rigl", **others})
    assert settings.robust_value == {}


def test_runs_with_other_arguments_of_it_are_not_averaged():
    settings = Settings(RLX2)
    assert settings.changed({"multi_step": 3}, SAC).variant() == settings.variant()
    other = settings.changed({"multi_step": 5}, SAC)
    assert other.variant() != settings.variant()
    assert other.variant(["multi_step"]) == settings.variant(["multi_step"])
    plain = Settings({**RLX2, "callback": RLX2["callback"][:1]})
    assert plain.robust_value is None
    assert plain.variant() != settings.variant()


def test_its_arguments_mean_nothing_without_it():
    plain = Settings({**RLX2, "callback": RLX2["callback"][:1]})
    with pytest.raises(ConfigError, match="multi_step means nothing here: .* --method rlx2"):
        plain.changed({"multi_step": 3}, SAC)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"multistep": 3}, "RobustValueCallback has no argument 'multistep'.*'multi_step'"),
        ({"multi_step": 0}, "multi_step must be a whole number, 1 or more, got 0"),
        ({"multi_step_begin": "1e-1"}, "the text '1e-1', as YAML reads a number"),
        ([3], "takes a mapping of arguments"),
    ],
)
def test_its_arguments_are_checked_before_training(arguments, said):
    settings = Settings({**RLX2, "callback": [RLX2["callback"][0], {ROBUST: arguments}]})
    with pytest.raises(ConfigError, match=said):
        check_settings(settings, SAC)


def test_further_callbacks_tell_runs_apart():
    reset = {"sb3_sparse.ResetCallback": {"interval": 10}}
    settings = Settings({**RLX2, "callback": [RLX2["callback"][0], reset]})
    plain = Settings({**RLX2, "callback": RLX2["callback"][:1]})
    other = Settings({**RLX2, "callback": [{"sb3_sparse.ResetCallback": {"interval": 20}}]})
    assert len({one.variant() for one in (settings, plain, other)}) == 3
    assert settings.callback == {"method": "rigl"}
