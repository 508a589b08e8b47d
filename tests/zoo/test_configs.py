"""The shipped configs: the paper's tables, value by value, and settings that work."""

from __future__ import annotations

import gymnasium as gym
import pytest
import yaml
from rl_zoo3.exp_manager import ExperimentManager
from zoo import paper_tables as paper

import sb3_sparse.zoo.configs as configs
from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.arguments import arguments_of
from sb3_sparse.zoo import config_path
from sb3_sparse.zoo.callbacks import CALLBACK
from sb3_sparse.zoo.configs import METHODS, config_folders, entry_of, evaluation_of, is_preset
from sb3_sparse.zoo.environments import is_atari
from sb3_sparse.zoo.names import ZOO_KEYS
from sb3_sparse.zoo.settings import Settings
from sb3_sparse.zoo.spec import RunSpec, algorithms
from sb3_sparse.zoo.validation import check_settings

SHIPPED = sorted(configs.config_root().glob("*/*.yml"))
MUJOCO_IDS = [f"{name}-{version}" for name in paper.MUJOCO for version in ("v5", "v4")]
PRESETS = [name for name in config_folders() if is_preset(name)]
GAME_IDS = [f"{game}NoFrameskip-v4" for game in paper.GAMES]


def entry(method, name, env_id):
    return entry_of(config_path(method, name), env_id, is_atari(env_id))


def assert_sparse_settings(settings, method, row):
    """Compare with a row (weight decay, update interval, drop fraction, sparsity-aware init)."""
    kwargs = settings["policy_kwargs"]
    callback = settings["callback"][0][CALLBACK] if "callback" in settings else {}
    found = (
        kwargs["weight_decay"],
        callback.get("update_interval"),
        callback.get("drop_fraction"),
        kwargs.get("sparsity_aware_init"),
    )
    assert found == row
    assert Settings(settings).method == method
    assert kwargs["sparsity"] == (0.0 if method == "dense" else 0.9)
    assert kwargs.get("initial_sparsity") == (0.0 if method == "prune" else None)


def assert_has(settings, values):
    assert {name: settings[name] for name in values} == values


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("env_id", paper.CLASSIC)
def test_dqn_on_classic_control_is_as_in_the_tables(method, env_id):
    settings = entry(method, "dqn", env_id)
    assert_sparse_settings(settings, method, paper.DQN_SWEEP[method])
    assert_has(settings, paper.DQN_CLASSIC)
    assert settings["policy_kwargs"]["net_arch"] == paper.DQN_CLASSIC_WIDTHS
    decay = settings["exploration_fraction"] * settings["n_timesteps"]
    assert decay == pytest.approx(paper.EPSILON_DECAY_STEPS)
    evaluation = evaluation_of("dqn", env_id, atari=False)
    schedule = (settings["n_timesteps"], evaluation["eval_freq"], evaluation["eval_episodes"])
    assert schedule == paper.CLASSIC_SCHEDULE


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("env_id", MUJOCO_IDS)
def test_sac_on_mujoco_is_as_in_the_tables(method, env_id):
    settings = entry(method, "sac", env_id)
    assert_sparse_settings(settings, method, paper.SAC_SWEEP[method])
    assert_has(settings, paper.SAC)
    assert settings["policy_kwargs"]["net_arch"] == paper.SAC_WIDTHS
    assert settings["learning_starts"] == paper.SAC_STARTS[env_id.split("-")[0]]
    evaluation = evaluation_of("sac", env_id, atari=False)
    schedule = (settings["n_timesteps"], evaluation["eval_freq"], evaluation["eval_episodes"])
    assert schedule == paper.MUJOCO_SAC_SCHEDULE


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("env_id", MUJOCO_IDS)
def test_ppo_on_mujoco_is_as_in_the_tables(method, env_id):
    settings = entry(method, "ppo", env_id)
    assert_sparse_settings(settings, method, paper.PPO_SWEEP[method])
    assert_has(settings, paper.PPO)
    assert settings["policy_kwargs"]["net_arch"] == paper.PPO_WIDTHS
    evaluation = evaluation_of("ppo", env_id, atari=False)
    schedule = (settings["n_timesteps"], evaluation["eval_freq"], evaluation["eval_episodes"])
    assert schedule == paper.MUJOCO_PPO_SCHEDULE


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("env_id", GAME_IDS)
@pytest.mark.parametrize(
    ("name", "table", "learning"),
    [
        ("dqn", paper.ATARI_CNN, paper.CNN),
        ("dqn_impala", paper.ATARI_RESNET, paper.RESNET),
    ],
)
def test_dqn_on_atari_is_as_in_the_tables(method, env_id, name, table, learning):
    settings = entry(method, name, env_id)
    kwargs = settings["policy_kwargs"]
    assert_sparse_settings(settings, method, table[method])
    assert_has(settings, paper.DQN_ATARI)
    assert (settings["learning_rate"], kwargs["optimizer_kwargs"]["eps"]) == learning
    assert kwargs["net_arch"] == []
    assert settings["frame_stack"] == 4
    decay = settings["exploration_fraction"] * settings["n_timesteps"]
    assert decay == pytest.approx(paper.EPSILON_DECAY_STEPS)
    evaluation = evaluation_of("dqn", env_id, atari=True)
    assert (settings["n_timesteps"], evaluation["eval_freq"]) == paper.ATARI_SCHEDULE
    if name == "dqn_impala":
        extractor = kwargs["features_extractor_kwargs"]
        assert extractor["channels"] == paper.RESNET_FILTERS
        assert extractor["features_dim"] == paper.DENSE_UNITS


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("algos", "table", "without"),
    [
        (("td3", "ddpg", "tqc", "crossq"), paper.SAC_SWEEP, ()),
        (("qrdqn",), paper.DQN_SWEEP, ("atari",)),
        (("a2c", "trpo"), paper.PPO_SWEEP, ()),
    ],
)
def test_other_algorithms_have_the_sparse_settings_of_their_kin(method, algos, table, without):
    for algo in algos:
        path = config_path(method, algo)
        assert "Not in the paper" in path.read_text()
        for key in yaml.safe_load(path.read_text()):
            if key not in without:
                settings = entry_of(path, key, atari=key == "atari")
                assert_sparse_settings(settings, method, table[method])


def comparable(settings, policy_kwargs):
    """Without what makes it sparse; defaults that only say a width are left out too."""
    ours = ("policy", "callback", "policy_kwargs")
    kept = {name: value for name, value in settings.items() if name not in ours}
    mine = ("sparsity", "initial_sparsity", "sparsity_aware_init", "weight_decay", "net_arch")
    kept.update({k: v for k, v in policy_kwargs.items() if k not in mine})
    return kept


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("algo", ["td3", "ddpg", "tqc", "crossq", "qrdqn", "a2c", "trpo"])
def test_base_values_of_the_others_are_those_of_the_installed_zoo(method, algo):
    path = config_path(method, algo)
    import rl_zoo3

    theirs = yaml.safe_load(
        (configs.Path(rl_zoo3.__file__).parent / "hyperparams" / f"{algo}.yml").read_text()
    )
    for key in yaml.safe_load(path.read_text()):
        base = theirs.get(key.replace("-v5", "-v4"), theirs["default"])
        settings = entry_of(path, key, atari=key == "atari")
        if key == "atari" and algo == "a2c":
            base = {**base, "policy_kwargs": "dict()"}  # classes, which the file names by path
            for name in ("optimizer_class", "optimizer_kwargs"):
                settings["policy_kwargs"].pop(name)
        kwargs = eval(base.get("policy_kwargs", "dict()"))
        expected = comparable(base, kwargs)
        assert comparable(settings, settings["policy_kwargs"]) == expected, key
        if "net_arch" in kwargs:
            assert settings["policy_kwargs"]["net_arch"] == kwargs["net_arch"]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_every_key_is_known_to_the_algorithm_the_policy_or_the_zoo(path):
    algorithm = algorithms()[path.stem.split("_")[0]]
    policy = arguments_of(algorithm.policy_aliases["SparsePolicy"])
    for key in yaml.safe_load(path.read_text()):
        settings = entry_of(path, key, atari=key == "atari")
        assert set(settings) <= arguments_of(algorithm) | ZOO_KEYS, key
        assert set(settings["policy_kwargs"]) <= policy, key
        if path.parent.name not in PRESETS:
            assert Settings(settings).method == path.parent.name


SIMBA = ("sac", "td3", "ddpg", "tqc", "dqn", "qrdqn", "ppo", "a2c")
OBSERVATIONS_ONLY = {"norm_obs": True, "norm_reward": False}


@pytest.mark.parametrize("algo", SIMBA)
def test_simba_networks_have_normalised_observations_and_adamw(algo):
    for key in yaml.safe_load(config_path("simba", algo).read_text()):
        if key == "default":
            continue
        settings = RunSpec(algo, key, method="simba").settings()
        assert settings.alias == "SparseSimbaPolicy"
        assert settings.method == "static"
        assert settings.policy_kwargs["sparsity"] == 0.8
        assert settings.policy_kwargs["optimizer_class"] == "torch.optim.AdamW"
        assert OBSERVATIONS_ONLY.items() <= settings["normalize"].items()


def test_simba_on_mujoco_is_as_in_sbx():
    settings = RunSpec("sac", "HalfCheetah-v5", method="simba").settings()
    assert_has(settings, {"learning_rate": 3e-4, "learning_starts": 10_000, "batch_size": 256})
    assert settings["normalize"] == OBSERVATIONS_ONLY
    kwargs = settings.policy_kwargs
    assert (kwargs["net_arch"], kwargs["n_critics"]) == ({"pi": [128], "qf": [256, 256]}, 2)
    assert kwargs["optimizer_kwargs"] == {"weight_decay": 1e-4}  # optax's


@pytest.mark.parametrize(
    ("task", "actions"), [("dog-stand", 38), ("dog-walk", 38), ("humanoid-stand", 21)]
)
def test_simba_on_the_control_suite_is_as_in_2506_17204(task, actions):
    pytest.importorskip("dm_control")
    run = RunSpec("sac", f"dm_control/{task}-v0", method="simba")
    settings = run.settings()
    assert_has(
        settings,
        {
            "n_timesteps": 1_000_000 // 2,
            "learning_rate": 1e-4,
            "buffer_size": 1_000_000,
            "learning_starts": 5000,
            "batch_size": 256,
            "gamma": 0.99,
            "tau": 0.005,
            "train_freq": 1,
            "gradient_steps": 2,
            "ent_coef": "auto_0.01",
            "target_entropy": -actions / 2,
            "normalize": {**OBSERVATIONS_ONLY, "clip_obs": float("inf")},
        },
    )
    assert settings["env_wrapper"][0] == {"sb3_sparse.wrappers.ActionRepeat": {"repeat": 2}}
    assert settings.policy_kwargs == {
        "net_arch": {"pi": [128], "qf": [512, 512]},
        "n_critics": 1,
        "optimizer_class": "torch.optim.AdamW",
        "optimizer_kwargs": {"weight_decay": 0.01},
        "sparsity": 0.8,
        "sparsity_aware_init": False,
    }
    assert run.evaluation() == {"eval_freq": 5000, "eval_episodes": 10}


def test_every_method_of_the_paper_has_every_algorithm():
    names = {*algorithms(), "dqn_impala"}
    of_paper = {(p.parent.name, p.stem) for p in SHIPPED if p.parent.name in METHODS}
    assert of_paper == {(m, n) for m in METHODS for n in names}
    assert {n for method, n in BEYOND if method == "granet"} == names


BEYOND = [(p.parent.name, p.stem) for p in SHIPPED if p.parent.name in ("granet", "mst")]


@pytest.mark.parametrize(("folder", "algo"), BEYOND)
def test_configs_beyond_the_paper_are_those_of_rigl_with_their_own_method(folder, algo):
    path = config_path(folder, algo)
    rigl = yaml.safe_load(config_path("rigl", algo).read_text())
    content = yaml.safe_load(path.read_text())
    assert content.keys() == rigl.keys()
    for key, settings in content.items():
        theirs, kwargs = rigl[key], rigl[key]["policy_kwargs"]
        if folder == "granet":
            kwargs["initial_sparsity"] = 0.45
            theirs["callback"][0][CALLBACK]["method"] = "granet"
        else:
            kwargs.update(sparsity=0.6, distribution="er")
            theirs["callback"][0][CALLBACK]["method"] = {"actor": "static", "critic": "rigl"}
        assert settings == theirs, key
        check_settings(Settings(settings), algorithms()[algo.partition("_")[0]])


def test_folders_are_methods_and_presets():
    assert config_folders()[:5] == list(METHODS)
    assert {"granet", "mst"} <= set(config_folders())
    presets = [name for name in config_folders() if is_preset(name)]
    assert "mst" in presets
    assert set(presets).isdisjoint([*METHODS, "granet"])
    assert not is_preset("gmp")


def test_our_lookup_is_that_of_the_zoo(tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text("default: {a: 1}\natari: {a: 2}\nPongNoFrameskip-v4: {a: 3}\n")
    for env_id in ("CartPole-v1", "QbertNoFrameskip-v4", "PongNoFrameskip-v4"):
        atari = ExperimentManager.is_atari(env_id)
        assert atari == is_atari(env_id)
        manager = ExperimentManager(None, "dqn", env_id, str(tmp_path), config=str(path))
        assert manager.read_hyperparameters()[0] == entry_of(path, env_id, atari)


def test_an_environment_without_settings_says_which_file_which_keys_and_what_to_add(tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text("Pendulum-v1: {n_timesteps: 5}\n")
    with pytest.raises(ConfigError, match=r"mine\.yml has no settings for 'CartPole-v1'") as caught:
        RunSpec(conf_file=str(path)).settings()
    assert "its keys are Pendulum-v1" in str(caught.value)
    assert "`default` for every environment" in str(caught.value)
    with pytest.raises(ConfigError, match="`atari` for every Atari game"):
        RunSpec(conf_file=str(path), env_id="PongNoFrameskip-v4").settings()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[1, 2]", "must map environment ids"),
        ("a: [", "not valid YAML"),
        ("CartPole-v1: 3", "must be a mapping of settings"),
        ("CartPole-v1: {policy: MlpPolicy}", "policy must be sb3_sparse.SparsePolicy"),
        ("CartPole-v1: {policy: SparsePolicy, policy_kwargs: 'f()'}", "policy_kwargs must be a"),
        ("CartPole-v1: {policy: SparsePolicy}", "needs its sparsity"),
        ("CartPole-v1: {policy: SparsePolicy, policy_kwargs: {sparsity: 0.5}}", "lack n_timesteps"),
        (
            "CartPole-v1: {n_timesteps: 1e6, policy: SparsePolicy, policy_kwargs: {sparsity: 0.5}}",
            "n_timesteps is the text '1e6'.*!!float 1e6",
        ),
        (
            "CartPole-v1: {n_timesteps: no, policy: SparsePolicy, policy_kwargs: {sparsity: 0.5}}",
            "n_timesteps must be a whole number",
        ),
        (
            "CartPole-v1: {policy: SparsePolicy, callback: sb3_sparse.SparsityCallback}",
            "needs a method",
        ),
        (
            "CartPole-v1: {policy: SparsePolicy, callback: {sb3_sparse.SparsityCallback: }}",
            "needs a method",
        ),
        (
            "CartPole-v1: {policy: SparsePolicy, callback: {sb3_sparse.SparsityCallback: , a: 1}}",
            "a callback is one path",
        ),
    ],
)
def test_a_file_that_is_wrong_says_how(content, message, tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text(content)
    with pytest.raises(ConfigError, match=message):
        RunSpec(conf_file=str(path)).settings()


def test_what_is_not_shipped_names_what_is(tmp_path):
    with pytest.raises(ConfigError, match="only for a2c, crossq.*--conf-file"):
        config_path("rigl", "reinforce")
    with pytest.raises(ConfigError, match="only for dense, prune, static, set, rigl"):
        config_path("gmp", "sac")
    with pytest.raises(ConfigError, match="no config file"):
        RunSpec(conf_file=str(tmp_path / "none.yml")).settings()


def test_entries_are_copies():
    first = entry("rigl", "sac", "Ant-v5")
    first["policy_kwargs"]["sparsity"] = 0.1
    assert entry("rigl", "sac", "Ant-v5")["policy_kwargs"]["sparsity"] == 0.9


def test_all_environments_of_the_paper_exist():
    RunSpec(env_id="PongNoFrameskip-v4")  # registers the games
    for env_id in (*paper.CLASSIC, *MUJOCO_IDS, *GAME_IDS):
        assert env_id in gym.registry


# Table 2 of arXiv:2205.15043 and its published code: sparsities of actor and critic.
RLX2 = {
    "sac": {"HalfCheetah": (0.9, 0.8), "Hopper": (0.98, 0.95), "Walker2d": (0.9, 0.9),
            "Ant": (0.9, 0.75)},
    "td3": {"HalfCheetah": (0.9, 0.85), "Hopper": (0.98, 0.95), "Walker2d": (0.97, 0.95),
            "Ant": (0.96, 0.88)},
}  # fmt: skip


@pytest.mark.parametrize("algo", RLX2)
@pytest.mark.parametrize("version", ["v5", "v4"])
def test_rlx2_is_as_in_its_paper(algo, version):
    for name, (actor, critic) in RLX2[algo].items():
        run = RunSpec(algo, f"{name}-{version}", method="rlx2")
        settings = run.settings()
        assert settings.policy_kwargs["sparsity"] == {"actor": actor, "critic": critic}
        assert settings.policy_kwargs["distribution"] == "er"
        assert settings.callback == {
            "method": "rigl", "update_interval": 10_000, "drop_fraction": 0.5, "end": 1.0,
        }  # fmt: skip
        assert settings.robust_value == {
            "multi_step": 3, "multi_step_begin": 0.1, "check_interval": 10_000,
            "distance_threshold": 0.2, "min_buffer_size": 200_000, "oldest": 2048,
        }  # fmt: skip
        assert_has(settings, {"n_timesteps": 3_000_000, "buffer_size": 3_000_000,
                              "learning_starts": 25_000, "learning_rate": 3e-4,
                              "batch_size": 256})  # fmt: skip
        assert run.preset == "rlx2"


def test_a_preset_at_sparsity_0_is_dense_and_may_be_as_small_as_a_sparse_one():
    sparse, dense = (RunSpec("sac", "Pendulum-v1", method="simba", sparsity=s) for s in (0.8, 0.0))
    assert [run.name_of(run.settings()) for run in (sparse, dense)] == ["static", "dense"]
    matched = RunSpec("sac", "Pendulum-v1", method="simba", sparsity=0.0, match_params=0.8)
    assert matched.settings().is_dense
    with pytest.raises(ConfigError, match="give --method simba --sparsity 0"):
        RunSpec("sac", "Pendulum-v1", method="simba", match_params=0.8).settings()
    assert RunSpec("sac", "Hopper-v5", method="mst").preset == "mst"
    for preset in ("mst", "rlx2"):
        run = RunSpec("sac", "Hopper-v5", method=preset)
        assert run.name_of(run.settings()) == preset
