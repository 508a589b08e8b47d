"""Models of SBX, exported; needs SBX itself."""

from __future__ import annotations

import base64
import json
import pickle
import sys
import zipfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from gymnasium import spaces
from stable_baselines3 import DQN, PPO, SAC, TD3
from stable_baselines3.common import save_util
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from support import command

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export import export_policy
from sb3_sparse.export.numpy_policy import Policy
from sb3_sparse.loading.sbx import load_sbx
from sb3_sparse.zoo.saved import SavedModel

sbx = pytest.importorskip("sbx", reason="SBX is not installed: pip install 'sb3-sparse[sbx]'")
import flax.linen as flax_nn  # noqa: E402
import jax  # noqa: E402

STOCK = {"sac": SAC, "td3": TD3, "ppo": PPO, "ppo_discrete": PPO, "dqn": DQN}


def small(**further):
    """Arguments of a policy, new ones for each model, since SBX adds to them."""
    return dict(net_arch=[16, 24], **further)


def observations(model, count=40):
    model.observation_space.seed(0)
    drawn = [model.observation_space.sample() for _ in range(count)]
    if isinstance(drawn[0], dict):
        return {key: np.stack([one[key] for one in drawn]) for key in drawn[0]}
    finite = np.stack(drawn)
    return np.clip(finite, -5, 5) if finite.dtype.kind == "f" else finite


def shaken(model):
    """The same model with random numbers added to all its parameters; biases are 0 at first."""
    rng = np.random.default_rng(0)

    def shake(leaf):
        return leaf + rng.normal(scale=0.1, size=np.shape(leaf)).astype(np.float32)

    for name, state in vars(model.policy).items():
        if name.endswith("_state"):
            changed = {
                one: jax.tree_util.tree_map(shake, getattr(state, one))
                for one in ("params", "target_params")
                if hasattr(state, one)
            }
            if hasattr(state, "batch_stats"):  # whose variances stay positive
                changed["batch_stats"] = jax.tree_util.tree_map(
                    lambda leaf: leaf + rng.random(np.shape(leaf)).astype(np.asarray(leaf).dtype),
                    state.batch_stats,
                )
            setattr(model.policy, name, state.replace(**changed))
    return model


@pytest.fixture(scope="module")
def zips(tmp_path_factory):
    """Zips of trained models, by name."""
    folder = tmp_path_factory.mktemp("sbx")
    rollouts = dict(n_steps=64, batch_size=32, n_epochs=2)
    both = dict(net_arch=dict(pi=[16, 24], qf=[24, 16]))
    models = {
        "sac": sbx.SAC("MlpPolicy", "Pendulum-v1", policy_kwargs=both, learning_starts=20),
        "td3": sbx.TD3("MlpPolicy", "Pendulum-v1", policy_kwargs=small(), learning_starts=20),
        "ppo": sbx.PPO("MlpPolicy", "Pendulum-v1", policy_kwargs=small(), **rollouts),
        "ppo_discrete": sbx.PPO("MlpPolicy", "CartPole-v1", policy_kwargs=small(), **rollouts),
        "dqn": sbx.DQN("MlpPolicy", "CartPole-v1", policy_kwargs=dict(net_arch=[16])),
    }
    for name, model in models.items():
        model.learn(128)
        model.save(folder / name)
    return {name: folder / f"{name}.zip" for name in models}


@pytest.fixture(scope="module")
def trained(zips):
    return {name: load_sbx(path, name.partition("_")[0]) for name, path in zips.items()}


@pytest.mark.parametrize("to", ["c", "numpy", "onnx", "dense"])
@pytest.mark.parametrize("name", STOCK)
def test_exports_act_as_sbx_does(trained, name, to, tmp_path):
    model = trained[name]
    report = export_policy(model, tmp_path / "policy", to)
    assert report.parity.holds
    seen = observations(model)
    expected, _ = model.predict(seen, deterministic=True)
    if to == "numpy":
        np.testing.assert_allclose(Policy(tmp_path / "policy.npz")(seen), expected, atol=2e-5)
    elif to == "dense":
        stock = STOCK[name].load(tmp_path / "policy.zip")
        actions, _ = stock.predict(seen, deterministic=True)
        np.testing.assert_allclose(actions, expected, atol=2e-5)


def test_the_command_line_takes_a_zip(zips, monkeypatch, capsys, tmp_path):
    code, said = command(
        monkeypatch, capsys, "export", zips["sac"], "--env", "Pendulum-v1", tmp_path / "p"
    )
    assert code == 0, said
    assert "1000 recorded and 1000 random observations" in said


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_a_policy_is_unpickled_once(zips, name, monkeypatch):
    with zipfile.ZipFile(zips[name]) as archive:
        policy = json.loads(archive.read("data"))["policy"][":serialized:"]
    loads, times = save_util.cloudpickle.loads, []

    def counted(content):
        times.append(content == base64.b64decode(policy))
        return loads(content)

    monkeypatch.setattr(save_util.cloudpickle, "loads", counted)
    model = SavedModel.find(zips[name], env_id="Pendulum-v1").load()
    assert sum(times) == 1
    expected = load_sbx(zips[name], name)
    seen = observations(model)
    acted = [one.predict(seen, deterministic=True)[0] for one in (model, expected)]
    np.testing.assert_array_equal(*acted)


def test_an_export_twice_gives_the_same_bytes(trained, tmp_path):
    for to, name in (("c", "a.c"), ("dense", "a.zip")):
        export_policy(trained["sac"], tmp_path / "a", to)
        export_policy(trained["sac"], tmp_path / "b", to)
        assert (tmp_path / name).read_bytes() == (tmp_path / name.replace("a", "b")).read_bytes()


def test_a_dense_zip_has_critics_targets_and_the_entropy_coefficient(trained, tmp_path):
    model = trained["sac"]
    export_policy(model, tmp_path / "policy", "dense")
    stock = SAC.load(tmp_path / "policy.zip")
    seen = observations(model)
    actions = np.random.default_rng(0).uniform(-1, 1, (len(seen), 1)).astype(np.float32)
    state = model.policy.qf_state
    dropout = {"dropout": jax.random.PRNGKey(0)}
    for theirs, critic in ((state.params, "critic"), (state.target_params, "critic_target")):
        expected = np.asarray(model.policy.qf.apply(theirs, seen, actions, rngs=dropout))
        with th.no_grad():
            ours = getattr(stock, critic)(th.from_numpy(seen), th.from_numpy(actions))
        assert expected.shape == (2, len(seen), 1)
        np.testing.assert_allclose(th.stack(ours).numpy(), expected, atol=1e-5)
    assert not np.allclose(
        stock.critic.qf0[0].weight.detach(), stock.critic_target.qf0[0].weight.detach(), atol=1e-7
    )
    coefficient = float(model.ent_coef_state.params["log_ent_coef"])
    assert coefficient != 0.0
    assert float(stock.log_ent_coef.detach()) == coefficient
    assert (stock.learning_starts, stock.num_timesteps, stock.ent_coef) == (20, 128, "auto")
    assert not stock.actor.optimizer.state_dict()["state"]


def test_values_and_distributions_are_those_of_sbx(trained, tmp_path):
    model = trained["sac"]
    export_policy(model, tmp_path / "policy", "numpy", with_value=True, stochastic=True)
    seen = observations(model)
    action, value, mean, std = Policy(tmp_path / "policy.npz")(seen)
    policy, low, high = model.policy, model.action_space.low, model.action_space.high
    scaled = 2 * (action - low) / (high - low) - 1
    dropout = {"dropout": jax.random.PRNGKey(0)}
    estimates = policy.qf.apply(policy.qf_state.params, seen, scaled, rngs=dropout)
    np.testing.assert_allclose(value, np.asarray(estimates).min(axis=0)[:, 0], atol=1e-5)
    gaussian = policy.actor.apply(policy.actor_state.params, seen).distribution
    np.testing.assert_allclose(mean, gaussian.mean(), atol=1e-5)
    np.testing.assert_allclose(std, gaussian.stddev(), atol=1e-5)
    model = trained["ppo"]
    export_policy(model, tmp_path / "policy", "numpy", with_value=True, stochastic=True)
    seen, policy = observations(model), model.policy
    action, value, mean, std = Policy(tmp_path / "policy.npz")(seen)
    expected = np.asarray(policy.vf.apply(policy.vf_state.params, seen))[:, 0]
    np.testing.assert_allclose(value, expected, atol=1e-5)
    gaussian = policy.actor.apply(policy.actor_state.params, seen)
    np.testing.assert_allclose(mean, gaussian.mean(), atol=1e-5)
    np.testing.assert_allclose(std, np.broadcast_to(gaussian.stddev(), mean.shape), atol=1e-5)


def test_values_of_a_dense_zip_are_those_of_sbx(trained, tmp_path):
    export_policy(trained["ppo"], tmp_path / "ppo", "dense")
    stock, model = PPO.load(tmp_path / "ppo.zip"), trained["ppo"]
    seen = observations(model)
    expected = np.asarray(model.policy.vf.apply(model.policy.vf_state.params, seen))
    with th.no_grad():
        ours = stock.policy.predict_values(th.from_numpy(seen))
    np.testing.assert_allclose(ours.numpy(), expected, atol=1e-5)
    export_policy(trained["dqn"], tmp_path / "dqn", "dense")
    value, model = DQN.load(tmp_path / "dqn.zip"), trained["dqn"]
    seen = observations(model)
    state = model.policy.qf_state
    for theirs, network in ((state.params, "q_net"), (state.target_params, "q_net_target")):
        expected = np.asarray(model.policy.qf.apply(theirs, seen))
        with th.no_grad():
            ours = getattr(value, network)(th.from_numpy(seen))
        np.testing.assert_allclose(ours.numpy(), expected, atol=1e-4)


@pytest.mark.parametrize("name", STOCK)
def test_a_dense_zip_trains_on(trained, name, tmp_path):
    export_policy(trained[name], tmp_path / "policy", "dense")
    env = "CartPole-v1" if name in ("ppo_discrete", "dqn") else "Pendulum-v1"
    stock = STOCK[name].load(tmp_path / "policy.zip", env=gym.make(env))
    before = {key: value.clone() for key, value in stock.policy.state_dict().items()}
    stock.learning_starts = 20
    stock.learn(64, reset_num_timesteps=False)
    assert stock.num_timesteps == 128 + 64
    assert any((value != before[key]).any() for key, value in stock.policy.state_dict().items())


def test_compress_takes_the_dense_zip_and_says_so(zips, monkeypatch, capsys, tmp_path):
    code, said = command(monkeypatch, capsys, "compress", zips["dqn"], "--env", "CartPole-v1")
    assert code == 2
    assert "--to dense sb3.zip` makes a zip of SB3 of it, which also `compress` takes" in said
    out = tmp_path / "sb3.zip"
    code, said = command(monkeypatch, capsys, "export", zips["dqn"], "--to", "dense", out)
    assert code == 0, said
    arguments = ("--sparsity", 0.5, "--steps", 20, "--eval-episodes", 2)
    code, said = command(monkeypatch, capsys, "compress", out, "--env", "CartPole-v1", *arguments)
    assert code == 0, said


def test_enjoy_plays_a_zip(zips, monkeypatch, capsys):
    code, said = command(
        monkeypatch, capsys, "enjoy", zips["ppo"], "--env", "Pendulum-v1", "-n", "1"
    )
    assert code == 0, said
    assert "Return over 1 episode:" in said


def test_a_run_brings_its_normalisation(monkeypatch, capsys, tmp_path):
    envs = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    model = sbx.PPO("MlpPolicy", envs, n_steps=64, batch_size=32, policy_kwargs=small())
    model.learn(64)
    folder = tmp_path / "logs" / "ppo" / "Pendulum-v1_1"
    parameters = folder / "Pendulum-v1"
    parameters.mkdir(parents=True)
    model.save(folder / "Pendulum-v1")
    envs.save(parameters / "vecnormalize.pkl")
    (parameters / "args.yml").write_text(yaml.dump(dict(algo="ppo", env="Pendulum-v1", seed=0)))
    (parameters / "config.yml").write_text(yaml.dump(dict(normalize=True)))
    out = tmp_path / "p"
    code, said = command(monkeypatch, capsys, "export", folder, "--to", "numpy", out)
    assert code == 0, said
    assert "1000 recorded" in said
    raw = observations(model)
    normalization = pickle.loads((parameters / "vecnormalize.pkl").read_bytes())
    expected, _ = model.predict(normalization.normalize_obs(raw), deterministic=True)
    np.testing.assert_allclose(Policy(tmp_path / "p.npz")(raw), expected, atol=2e-5)
    assert not np.allclose(expected, model.predict(raw, deterministic=True)[0], atol=1e-3)

    alone = (folder / "Pendulum-v1.zip").rename(tmp_path / "alone.zip")
    code, said = command(monkeypatch, capsys, "export", alone, out)
    assert code == 2
    assert "was trained with VecNormalize; give its statistics with --vecnormalize" in said
    statistics = ("--vecnormalize", parameters / "vecnormalize.pkl")
    code, said = command(monkeypatch, capsys, "export", alone, out, *statistics)
    assert code == 0, said


DICT = spaces.Dict({"b": spaces.Box(-1, 1, (3,)), "a": spaces.MultiBinary(2)})
CHOICES = spaces.MultiDiscrete([3, 2])


class Task(gym.Env):
    """An environment with any spaces."""

    def __init__(self, observation_space=None, action_space=None):
        self.observation_space = observation_space or spaces.Box(-1, 1, (3,))
        self.action_space = action_space or spaces.Box(-3, 1, (2,))

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


IMAGES = spaces.Box(0, 255, (36, 36, 3), np.uint8)
OTHERS = {
    "simba": lambda: sbx.SAC("SimbaPolicy", Task(), policy_kwargs=dict(net_arch=[16, 16])),
    "tqc": lambda: sbx.TQC("MlpPolicy", Task(), policy_kwargs=small()),
    "simba_tqc": lambda: sbx.TQC("SimbaPolicy", Task(), policy_kwargs=dict(net_arch=[16])),
    "crossq": lambda: sbx.CrossQ("MlpPolicy", Task(), policy_kwargs=small()),
    "ddpg": lambda: sbx.DDPG("MlpPolicy", Task(), policy_kwargs=small()),
    "droq": lambda: sbx.SAC(
        "MlpPolicy", Task(), policy_kwargs=small(layer_norm=True, dropout_rate=0.01)
    ),
    "gsde": lambda: sbx.SAC("MlpPolicy", Task(), use_sde=True, policy_kwargs=small()),
    "dict": lambda: sbx.TD3("MultiInputPolicy", Task(DICT), policy_kwargs=small()),
    "choices": lambda: sbx.PPO("MlpPolicy", Task(None, CHOICES), policy_kwargs=small()),
    "pixels": lambda: sbx.SAC("MlpPolicy", Task(IMAGES), policy_kwargs=small()),
    "dqn_cnn": lambda: sbx.DQN(
        "CnnPolicy", Task(IMAGES, spaces.Discrete(3)), policy_kwargs=dict(net_arch=[32])
    ),
    "ppo_cnn": lambda: sbx.PPO(
        "CnnPolicy",
        Task(IMAGES),
        policy_kwargs=dict(features_extractor_kwargs=dict(features_dim=32)),
    ),
    "gelu": lambda: sbx.PPO(
        "MlpPolicy", Task(), policy_kwargs=small(activation_fn=flax_nn.gelu)
    ),
}  # fmt: skip
NOT_DENSE = {
    "simba": "made of SimBa networks, which stock SB3 does not have",
    "simba_tqc": "made of SimBa networks, which stock SB3 does not have",
    "droq": "critics with layer_norm or dropout_rate have no counterpart",
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_policies_act_the_same(name, tmp_path):
    model = shaken(OTHERS[name]())
    assert export_policy(model, tmp_path / "policy", "numpy").parity.holds
    if name in NOT_DENSE:
        with pytest.raises(UnsupportedError, match=NOT_DENSE[name]):
            export_policy(model, tmp_path / "policy", "dense")
    else:
        assert export_policy(model, tmp_path / "policy", "dense").parity.holds


class OwnActor(flax_nn.Module):
    net_arch: tuple
    action_dim: int
    activation_fn: object = flax_nn.relu

    @flax_nn.compact
    def __call__(self, x):
        return flax_nn.Dense(self.action_dim)(x)


BITS = spaces.MultiBinary(2)
REJECTED = {
    "makes its networks": (
        lambda: sbx.SAC("MlpPolicy", Task(), policy_kwargs=dict(actor_class=OwnActor)),
        r"acting network is .*OwnActor cannot be exported; those with a counterpart",
    ),
    "observes numbers": (
        lambda: sbx.DQN("MlpPolicy", "FrozenLake-v1"),
        r"observations in Discrete\(16\) cannot be exported; allowed are Box",
    ),
    "acts by bits": (
        lambda: sbx.PPO("MlpPolicy", Task(None, BITS)),
        r"actions in MultiBinary\(2\) cannot be exported: it has two outputs for each",
    ),
    "has an activation of its own": (
        lambda: sbx.PPO("MlpPolicy", Task(), policy_kwargs=dict(activation_fn=jax.numpy.sin)),
        r"cannot be exported; those with a counterpart in torch are ReLU, Tanh",
    ),
}


@pytest.mark.parametrize("what", REJECTED)
def test_a_model_without_counterpart_is_rejected(what, tmp_path):
    make, message = REJECTED[what]
    with pytest.raises(UnsupportedError, match=message):
        export_policy(make(), tmp_path / "policy", "c")
    assert not list(Path(tmp_path).iterdir())


def test_a_policy_that_cannot_be_unpickled_is_no_new_policy(zips, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys.modules["sbx.sac.policies"], "SACPolicy", None)
    monkeypatch.delattr(sys.modules["sbx.sac.policies"], "SACPolicy")
    with pytest.warns(UserWarning, match="Could not deserialize object policy"):
        code, said = command(monkeypatch, capsys, "export", zips["sac"], tmp_path / "p")
    assert code == 2
    assert "cannot be unpickled" in said
