"""Settings are refused before anything is trained, with the key and what is allowed."""

from __future__ import annotations

import math

import numpy as np
import pytest
import yaml
from tuning_support import choices

from sb3_sparse.callback import SparsityCallback
from sb3_sparse.errors import ConfigError
from sb3_sparse.studies import Study
from sb3_sparse.tuning import Space
from sb3_sparse.tuning.backend import optuna
from sb3_sparse.tuning.spaces import check_space
from sb3_sparse.zoo.arguments import kind_of
from sb3_sparse.zoo.configs import METHODS, config_root, read_yaml
from sb3_sparse.zoo.names import Names
from sb3_sparse.zoo.settings import Settings
from sb3_sparse.zoo.spec import RunSpec, algorithms
from sb3_sparse.zoo.validation import OF_SPARSITY, check_settings

STEPS, SHARE = "a whole number, 1 or more", r"a number in \[0, 1\]"
WRONG = [  # algorithm, name, wrong values, what is allowed
    ("dqn", "learning_starts", ["abc", -1, 1.5, True, None], "a whole number, 0 or more"),
    ("dqn", "gamma", [5, -0.1, math.nan, "high", None, True], SHARE),
    ("dqn", "buffer_size", [0, -1, 1e6, "big"], STEPS),
    ("dqn", "tau", [math.nan, 2, -1, "soft"], SHARE),
    ("dqn", "max_grad_norm", [-1, 0, math.nan, None, "inf."], "a number above 0"),
    ("qrdqn", "max_grad_norm", [-1, 0], "a number above 0.*or null"),
    ("dqn", "batch_size", [-5, 0, 32.0, "few"], STEPS),
    ("dqn", "train_freq", [0, -1, [1], [0, "step"], [1, "steps"], "4x"], r"\[1, episode\]"),
    ("dqn", "gradient_steps", [0, -2, 1.5, "all"], "or -1"),
    ("dqn", "target_update_interval", [0, -1, "often"], STEPS),
    ("dqn", "exploration_fraction", [1.1, -0.1, "half"], SHARE),
    ("dqn", "exploration_initial_eps", [1.1, "x"], SHARE),
    ("dqn", "exploration_final_eps", [-0.1, "x"], SHARE),
    ("dqn", "n_steps", [0, "x"], STEPS),
    ("dqn", "optimize_memory_usage", [1, "yes"], "true or false"),
    ("dqn", "replay_buffer_class", [3, "a b"], "a class"),
    ("dqn", "replay_buffer_kwargs", [3, []], "a mapping"),
    ("td3", "action_noise", ["normal"], "noise_type"),
    ("sac", "ent_coef", ["automatic", "auto_x", "auto_0", -1, math.inf], "'auto', or auto_"),
    ("sac", "target_entropy", ["manual", None], "'auto', or a number"),
    ("sac", "learning_rate", [-1, "fast", "lin_", "lin_x", "lin_-1", None], "or lin_ and a number"),
    ("ppo", "ent_coef", ["auto", None, math.nan], "a number"),
    ("ppo", "clip_range", [0, -0.1, "lin_0", None], "a number above 0, or lin_"),
    ("ppo", "clip_range_vf", [0, "x"], "or lin_.*or null"),
    ("ppo", "gae_lambda", [1.5, "x"], SHARE),
    ("ppo", "n_epochs", [0, "x"], STEPS),
    ("ppo", "vf_coef", [-1, "x"], "a number, 0 or more"),
    ("ppo", "normalize_advantage", ["x", 0], "true or false"),
    ("ppo", "target_kl", [0, -1], "above 0, or null"),
    ("ppo", "use_sde", ["x"], "true or false"),
    ("ppo", "sde_sample_freq", [0, -2], "or -1"),
    ("ppo", "stats_window_size", [0], STEPS),
    ("ppo", "rollout_buffer_class", [3], "a class"),
    ("ppo", "rollout_buffer_kwargs", [3], "a mapping"),
    ("a2c", "rms_prop_eps", [0, -1], "above 0"),
    ("a2c", "use_rms_prop", ["x"], "true or false"),
    ("td3", "policy_delay", [0], STEPS),
    ("td3", "target_policy_noise", [-0.1], "0 or more"),
    ("td3", "target_noise_clip", [-0.1], "0 or more"),
    ("td3", "noise_type", ["white"], "'normal' or 'ornstein-uhlenbeck'"),
    ("td3", "noise_std", [-0.1], "0 or more"),
    ("tqc", "top_quantiles_to_drop_per_net", [-1], "0 or more"),
    ("sac", "use_sde_at_warmup", [1], "true or false"),
    ("trpo", "target_kl", [None, 0], "above 0"),
    ("trpo", "cg_max_steps", [0], STEPS),
    ("trpo", "cg_damping", [-1], "0 or more"),
    ("trpo", "line_search_shrinking_factor", [0, 1], "above 0 and below 1"),
    ("trpo", "line_search_max_iter", [0], STEPS),
    ("trpo", "n_critic_updates", [0], STEPS),
    ("trpo", "sub_sampling_factor", [0], STEPS),
    ("dqn", "n_envs", [0, 1.5, "x"], STEPS),
    ("dqn", "n_timesteps", [0, 0.5, 10.5, math.inf, "x"], STEPS),
    ("dqn", "frame_stack", [0, "x"], STEPS),
    ("dqn", "normalize", [3, ""], "true or false"),
    ("dqn", "env_kwargs", [3], "a mapping"),
    ("dqn", "monitor_kwargs", [3], "a mapping"),
    ("dqn", "env_wrapper", [3, [3]], "a dotted path"),
    ("dqn", "vec_env_wrapper", [3], "a dotted path"),
    ("dqn", "net_arch", [64, [0], [64.0], "64x64", {"pi": [4], "qf": [4]}], "a list of widths"),
    ("sac", "net_arch", [{"pi": [4]}, {"pi": [4], "vf": [4]}, (4, 4)], r"\{pi: .*qf: "),
    ("ppo", "net_arch", [{"pi": [4], "qf": [4]}, {}], r"\{pi: .*vf: "),
    ("dqn", "activation_fn", [3, "torch nn"], "a class"),
    ("dqn", "features_extractor_class", [3], "a class"),
    ("dqn", "features_extractor_kwargs", [3], "a mapping"),
    ("dqn", "optimizer_class", [3], "a class"),
    ("dqn", "optimizer_kwargs", [3], "a mapping"),
    ("dqn", "normalize_images", [3], "true or false"),
    ("dqn", "weight_decay", [-1.0, math.nan], "0 or more"),
    ("sac", "n_critics", [0, "x"], STEPS),
    ("sac", "share_features_extractor", ["x"], "true or false"),
    ("sac", "clip_mean", [0], "above 0"),
    ("sac", "use_expln", ["x"], "true or false"),
    ("sac", "log_std_init", ["x"], "a number"),
    ("ppo", "ortho_init", ["x"], "true or false"),
    ("ppo", "full_std", ["x"], "true or false"),
    ("qrdqn", "n_quantiles", [0], STEPS),
    ("crossq", "batch_norm", ["x"], "true or false"),
    ("crossq", "batch_norm_eps", [0], "above 0"),
    ("crossq", "batch_norm_momentum", [2], SHARE),
    ("crossq", "renorm_warmup_steps", [-1], "0 or more"),
]
GOOD = [
    ("dqn", "learning_rate", "lin_3e-4"),
    ("dqn", "learning_rate", np.float32(0.5)),
    ("dqn", "batch_size", np.int64(32)),
    ("dqn", "train_freq", (1, "episode")),
    ("dqn", "train_freq", [4, "step"]),
    ("dqn", "gradient_steps", -1),
    ("dqn", "max_grad_norm", math.inf),
    ("qrdqn", "max_grad_norm", None),
    ("dqn", "net_arch", []),
    ("dqn", "gamma", 1),
    ("sac", "ent_coef", "auto_0.1"),
    ("sac", "ent_coef", 0.2),
    ("sac", "net_arch", {"pi": [4], "qf": [8, 8]}),
    ("ppo", "clip_range", "lin_0.2"),
    ("ppo", "clip_range_vf", None),
    ("ppo", "normalize", "dict(norm_obs=True, norm_reward=False)"),
    ("ppo", "ent_coef", -0.01),
    ("ppo", "env_wrapper", [{"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 5}}]),
]
ENVS = {"dqn": "CartPole-v1", "qrdqn": "CartPole-v1"}

REDO = "sb3_sparse.RecycleDormantCallback"


def made(algo, **more):
    return RunSpec(algo=algo, env_id=ENVS.get(algo, "Pendulum-v1"), **more)


@pytest.mark.parametrize(("algo", "name", "values", "allowed"), WRONG)
def test_a_wrong_value_is_refused_with_its_key_and_what_is_allowed(algo, name, values, allowed):
    for value in values:
        with pytest.raises(ConfigError, match=f"^{name} must be .*{allowed}") as caught:
            made(algo, hyperparams={name: value}).settings()
        assert f"got {value!r}" in str(caught.value)


@pytest.mark.parametrize(("algo", "name", "value"), GOOD)
def test_a_value_that_sb3_or_the_zoo_takes_is_let_through(algo, name, value):
    made(algo, hyperparams={name: value}).settings()


@pytest.mark.parametrize("algo", algorithms())
def test_the_table_knows_every_argument_of_every_algorithm_and_policy(algo):
    names = Names.of(algorithms()[algo])
    missing = [n for n in names.algorithm | names.policy if kind_of(algo, n) is None]
    assert set(missing) <= OF_SPARSITY
    tested = {(one if kind_of(one, name) else "", name) for one, name, _, _ in WRONG}
    untested = names.algorithm | names.policy
    untested = untested - {name for _, name in tested} - OF_SPARSITY
    assert untested <= {"callback", "policy", "policy_kwargs", "squash_output"}


def test_every_shipped_entry_passes():
    checked = 0
    for method in METHODS:
        for path in (config_root() / method).glob("*.yml"):
            algorithm = algorithms()[path.stem.split("_")[0]]
            for entry in read_yaml(path).values():
                check_settings(Settings(entry), algorithm)
                checked += 1
    assert checked > 200


def test_the_same_table_serves_files_options_studies_and_spaces(tmp_path):
    said = r"gamma must be a number in \[0, 1\]; got 5"
    config = tmp_path / "mine.yml"
    entry = {
        "policy": "SparsePolicy",
        "n_timesteps": 100,
        "gamma": 5,
        "policy_kwargs": {"sparsity": 0.5},
    }
    config.write_text(yaml.safe_dump({"default": entry}))
    with pytest.raises(ConfigError, match=said):
        RunSpec(conf_file=str(config)).settings()
    with pytest.raises(ConfigError, match=said):
        RunSpec(hyperparams={"gamma": 5}).settings()
    study = tmp_path / "study.yml"
    runs = [
        {"algo": "dqn", "env_id": "CartPole-v1", "method": "dense", "vary": {"gamma": [0.9, 5]}}
    ]
    content = {"title": "T", "figures": ["iqm"], "runs": runs, "scales": {"smoke": {}}}
    study.write_text(yaml.safe_dump(content))
    with pytest.raises(ConfigError, match=f"study.yml, scale smoke: {said}"):
        Study.read(str(study), "smoke")
    with pytest.raises(ConfigError, match=said):
        check_space(choices(gamma=[0.9, 5]), RunSpec())
    high = optuna.distributions.FloatDistribution(0.9, 5)
    with pytest.raises(ConfigError, match=r"gamma must be a number in \[0, 1\]; got [1-5]\."):
        check_space(Space("mine", {"gamma": high}), RunSpec())


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"gama": 0.9}, "DQN and rl-zoo have no setting 'gama' .did you mean 'gamma'"),
        ({"clip_range": 0.2}, "DQN and rl-zoo have no setting 'clip_range'"),
        ({"sparsity": 0.5}, "put it under policy_kwargs"),
        ({"update_interval": 5}, "put it under sb3_sparse.SparsityCallback"),
        ({"seed": 3}, "'seed'; it has its own option"),
        ({3: 4}, "no setting 3"),
        (
            {"policy_kwargs": {"sparsity": 0.5, "net_arc": [4]}},
            "policy_kwargs of DQN have no 'net_arc' .did you mean 'net_arch'",
        ),
        ({"policy_kwargs": {"sparsity": 0.5, "gamma": 0.9}}, "put it beside policy_kwargs"),
        ({"policy_kwargs": {"sparsity": 0.5, "squash_output": True}}, "have no 'squash_output'"),
        ({"policy_kwargs": {"sparsity": "high"}}, r"sparsity must be a number in \[0, 1\)"),
        (
            {"policy_kwargs": {"sparsity": 0.5, "activation_fn": "torch.nn.Rel"}},
            "cannot be imported",
        ),
        (
            {"callback": {"sb3_sparse.SparsityCallback": {"method": "set", "update_intervall": 5}}},
            "has no argument 'update_intervall' .did you mean 'update_interval'",
        ),
        (
            {"callback": {"sb3_sparse.callbacks.RobustValueCallback": {"multi_stp": 3}}},
            "RobustValueCallback has no argument 'multi_stp' .did you mean 'multi_step'",
        ),
        (
            {"callback": [REDO, {"sb3_sparse.ResetCallback": {"intervall": 3}}]},
            "sb3_sparse.ResetCallback has no argument 'intervall' .did you mean 'interval'",
        ),
        (
            {"callback": {REDO: {"tau": -1}}},
            "tau must be a number, 0 or more, got -1",
        ),
        (
            {"callback": {"sb3_sparse.ResetCallback": 3}},
            "sb3_sparse.ResetCallback takes a mapping of arguments",
        ),
        ({"callback": [3]}, "a callback is a dotted path, e.g. .*got 3"),
        (
            {"policy_kwargs": {"sparsity": 0.5, "optimizer_kwargs": {"eps": "1e-5"}}},
            "eps is the text '1e-5'.*write eps: !!float 1e-5",
        ),
        ({"noise_type": "normal"}, "noise_type needs noise_std"),
        ({"normalize": True, "frame_stack": 2}, "normalize and frame_stack cannot be combined"),
        ({"policy_kwargs": {"sparsity": 0.5, "dense_layers": 3}}, "dense_layers must be a list"),
        ({"learning_rate": "nan"}, "learning_rate must be a number, 0 or more"),
    ],
)
def test_a_key_that_nothing_takes_is_refused_with_the_nearest_or_its_place(changed, said):
    entry = {"policy": "SparsePolicy", "n_timesteps": 9, "policy_kwargs": {"sparsity": 0.5}}
    with pytest.raises(ConfigError, match=said):
        RunSpec(entry={**entry, **changed}).settings()


@pytest.mark.parametrize(
    ("initial", "final", "method", "said"),
    [
        (0.0, 0.9, None, "begins denser than sparsity: 0.9, and without a callback training would"),
        (0.5, 0.9, None, "without a callback"),
        (0.0, {"q_net": 0.9}, None, "without a callback"),
        (0.0, 0.9, "rigl", "with method 'rigl' training would keep q_net that dense"),
        (0.0, 0.9, "static", "with method 'static'"),
        (None, 0.9, "prune", "method 'prune' begins denser than it ends"),
        (0.9, 0.9, "prune", "method 'prune' begins denser"),
        (0.0, 0.0, "prune", "method 'prune' begins denser"),
        (0.0, 0.9, "prune", None),
        (0.9, 0.9, None, None),
        (0.0, 0.0, None, None),
        (None, 0.9, "rigl", None),
    ],
)
def test_a_sparsity_that_training_would_not_reach_is_refused(initial, final, method, said):
    entry = {
        "policy": "SparsePolicy",
        "n_timesteps": 9,
        "policy_kwargs": {"sparsity": final, "initial_sparsity": initial},
    }
    if method is not None:
        entry["callback"] = [{"sb3_sparse.SparsityCallback": {"method": method}}]
    if said is None:
        RunSpec(entry=entry).settings()
        return
    with pytest.raises(ConfigError, match=said):
        RunSpec(entry=entry).settings()


class Weekly(SparsityCallback):
    """A callback of a user's own, with an argument of its own."""

    def __init__(self, method, weekday):
        super().__init__(method)


def test_a_subclass_of_the_callback_counts_as_it_and_keeps_its_arguments(monkeypatch):
    monkeypatch.setattr("sb3_sparse.zoo.Weekly", Weekly, raising=False)
    entry = {
        "policy": "SparsePolicy",
        "n_timesteps": 9,
        "policy_kwargs": {"sparsity": 0.5},
        "callback": {"sb3_sparse.zoo.Weekly": {"method": "rigl", "weekday": 3}},
    }
    RunSpec(entry=entry, method="rigl").settings()
    with pytest.raises(ConfigError, match="trains with method 'rigl', not 'static'"):
        RunSpec(entry=entry, method="static").settings()
