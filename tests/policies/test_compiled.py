"""Policies that torch compiled: whoever asks for a policy's class finds it."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv
from support import make

from sb3_sparse import RecycleDormantCallback, ResetCallback, sparsify
from sb3_sparse.analysis import (
    PlasticityCallback,
    dormant_share,
    effective_ranks,
    flops,
    gradient_snr,
)
from sb3_sparse.analysis.networks import connections, parameters_by_network, specs_of
from sb3_sparse.compress import compress_model
from sb3_sparse.compress.record import fingerprint
from sb3_sparse.errors import CorruptStateError
from sb3_sparse.export import FORMATS, export_policy
from sb3_sparse.policies.compiled import plain_names, unwrapped
from sb3_sparse.zoo.inspection import inspect_model
from sb3_sparse.zoo.saved_by import algos_of

pytestmark = pytest.mark.filterwarnings("error:Dynamo")
"""Torch compiles the modules, and never meets the kernels, of which it could only warn."""


@pytest.fixture(autouse=True)
def torch_as_it_was():
    """``torch.compile`` switches the checks of distributions off, for the whole process."""
    checked = th.distributions.Distribution._validate_args
    th._dynamo.reset()
    yield
    th.distributions.Distribution.set_default_validate_args(checked)


def compiled(algorithm, **arguments):
    """A model, and the same again with its policy compiled."""
    models = make(algorithm, **arguments), make(algorithm, **arguments)
    models[1].policy = th.compile(models[1].policy, backend="eager")
    return models


def test_a_compiled_policy_is_unwrapped_and_any_other_is_itself():
    policy = make("PPO").policy
    wrapped = th.compile(policy, backend="eager")
    assert type(wrapped) is not type(policy)
    assert unwrapped(wrapped) is policy
    assert unwrapped(policy) is policy
    assert plain_names(wrapped.state_dict()).keys() == policy.state_dict().keys()


@pytest.mark.parametrize("policy", ["SparsePolicy", "MlpPolicy"])
@pytest.mark.parametrize("algorithm", ["SAC", "PPO", "DQN"])
def test_it_is_exported_as_before(algorithm, policy, tmp_path):
    plain, wrapped = compiled(algorithm, policy=policy)
    for to in FORMATS:
        expected = export_policy(plain, tmp_path / f"plain-{to}", to)
        found = export_policy(wrapped, tmp_path / f"wrapped-{to}", to)
        assert found.parity.holds
        assert (found.nnz, found.units, found.notes) == (
            expected.nnz, expected.units, expected.notes
        )  # fmt: skip
    stock = type(plain).load(tmp_path / "wrapped-dense.zip")
    assert type(stock.policy).__module__.startswith("stable_baselines3.")
    assert stock.policy.state_dict().keys() == unwrapped(stock.policy).state_dict().keys()


@pytest.mark.parametrize("compute", ["masked", "sparse"])
def test_a_part_that_is_compiled_is_exported_too(compute, tmp_path):
    model = make("SAC", policy_kwargs=dict(compute=compute))
    actor = model.policy.actor
    actor.latent_pi = th.compile(actor.latent_pi, backend="eager")
    for to in FORMATS:
        assert export_policy(model, tmp_path / "policy", to).parity.holds


@pytest.mark.parametrize("compute", ["masked", "sparse"])
def test_a_model_with_a_compiled_part_is_saved_and_loaded(compute, tmp_path):
    plain, model = (make("SAC", policy_kwargs=dict(compute=compute)) for _ in range(2))
    actor = model.policy.actor
    actor.latent_pi = th.compile(actor.latent_pi, backend="eager")
    actor.mu.weight.data.mul_(2)
    model.save(tmp_path / "model.zip")
    loaded = type(plain).load(tmp_path / "model.zip")
    expected = plain_names(model.policy.state_dict())
    assert expected.keys() == loaded.policy.state_dict().keys()
    for name, value in loaded.policy.state_dict().items():
        assert th.equal(value, expected[name]), name
    for source in (plain.policy.state_dict(), model.policy.state_dict()):  # under either's names
        model.policy.load_state_dict(source)
        plain.policy.load_state_dict(source)
    wrong = plain.policy.state_dict()
    wrong["actor.latent_pi.0.weight_mask"] = th.ones_like(wrong["actor.latent_pi.0.weight_mask"])
    with pytest.raises(CorruptStateError, match="the mask of actor.latent_pi.0 has 72 of 72"):
        model.policy.load_state_dict(wrong)


@pytest.mark.parametrize("compute", ["masked", "sparse"])
def test_units_are_recycled_and_networks_reset_where_a_part_is_compiled(compute):
    models = []
    for wraps in (False, True):
        model = make("SAC", learning_starts=10, policy_kwargs=dict(compute=compute))
        if wraps:
            actor, head = model.policy.actor, model.policy.critic.qf0
            actor.latent_pi = th.compile(actor.latent_pi, backend="eager")
            head[2] = th.compile(head[2], backend="eager")
        model.learn(20)
        callbacks = (
            RecycleDormantCallback(tau=0.9),
            ResetCallback(),
            ResetCallback(layers=["output", "critic.qf0.2"]),
        )
        for step, callback in enumerate(callbacks):
            callback.init_callback(model)
            callback.act(step)
            model.learn(5, reset_num_timesteps=False)
            models.append(state_of(model))
    for plain, wrapped in zip(models[:3], models[3:], strict=True):
        assert plain.keys() == wrapped.keys()
        for name, value in wrapped.items():
            th.testing.assert_close(value, plain[name], rtol=1e-3, atol=1e-5, msg=name)


def state_of(model):
    state = plain_names(model.policy.state_dict())
    return {name: x.clone() for name, x in state.items() if isinstance(x, th.Tensor)}


def test_a_compression_knows_the_model_again():
    plain, wrapped = compiled("PPO")
    assert fingerprint(wrapped) == fingerprint(plain)


@pytest.mark.parametrize("compute", ["masked", "sparse"])
@pytest.mark.parametrize("algorithm", ["SAC", "PPO", "DQN"])
def test_a_saved_one_is_loaded_inspected_and_made_sparser(algorithm, compute, tmp_path):
    plain, wrapped = compiled(algorithm, policy_kwargs=dict(sparsity=0.7, compute=compute))
    wrapped.save(tmp_path / "model.zip")
    loaded = type(plain).load(tmp_path / "model.zip")
    for name, value in plain.policy.state_dict().items():
        assert th.equal(loaded.policy.state_dict()[name], value), name
    assert algos_of(tmp_path / "model.zip")[0] == algorithm.lower()
    report = inspect_model(tmp_path / "model.zip").report
    assert report == plain.policy.sparsity_report()
    twins = sparsify(plain, 0.9), sparsify(wrapped, 0.9)
    for name, value in twins[0].policy.state_dict().items():
        assert th.equal(twins[1].policy.state_dict()[name], value), name
    assert sparsify(compiled(algorithm, policy="MlpPolicy")[1], 0.9).policy.sparse.sparsity > 0.89


@pytest.mark.parametrize("policy", ["SparsePolicy", "MlpPolicy"])
@pytest.mark.parametrize("algorithm", ["SAC", "PPO", "DQN"])
def test_it_is_analysed_as_before(algorithm, policy):
    plain, wrapped = compiled(algorithm, policy=policy)
    assert specs_of(wrapped.policy) == specs_of(plain.policy)
    assert parameters_by_network(wrapped.policy) == parameters_by_network(plain.policy)
    assert connections(wrapped.policy).keys() == connections(plain.policy).keys()
    assert flops(wrapped) == flops(plain)
    assert flops(wrapped.policy) == flops(plain.policy)
    seen = np.random.default_rng(0).normal(size=(8, *plain.observation_space.shape))
    seen = seen.astype(np.float32)
    assert dormant_share(wrapped.policy, seen) == dormant_share(plain.policy, seen)
    assert effective_ranks(wrapped, seen) == effective_ranks(plain, seen)
    for model in (plain, wrapped):
        model.set_random_seed(0)
        model.learn(64, callback=PlasticityCallback(every=32))
    found, expected = (gradient_snr(model, batch_size=8) for model in (wrapped, plain))
    assert found.samples == expected.samples
    for ours, theirs in zip(found.networks, expected.networks, strict=True):
        assert ours.network == theirs.network
        # To rounding: torch compiles the modules, which the kernels act in place of otherwise.
        values = [
            [getattr(one, part) for part in ("all", "active", "inactive")] for one in (ours, theirs)
        ]
        assert values[0] == [value and pytest.approx(value, rel=1e-4) for value in values[1]]


def test_it_is_compressed(tmp_path):
    _, model = compiled("PPO", env="CartPole-v1", policy="MlpPolicy")
    envs = DummyVecEnv([lambda: gym.make("CartPole-v1")])
    outcome = compress_model(model, envs, tmp_path / "out", sparsity=0.5, steps=64, episodes=2)
    assert outcome.sparsity["actor"] == pytest.approx(0.5, abs=0.01)
    assert type(model).load(outcome.path).policy.sparsity_report().sparsity("actor") > 0.49


@pytest.mark.parametrize(("name", "compute"), [("SAC", "masked"), ("TD3", "sparse")])
def test_an_actor_that_is_compiled_acts_and_trains(name, compute):
    model = make(name, policy_kwargs=dict(compute=compute))
    obs = np.stack([model.observation_space.sample() for _ in range(3)])
    expected, _ = model.predict(obs, deterministic=True)
    model.actor = model.policy.actor = th.compile(model.policy.actor, backend="eager")
    np.testing.assert_allclose(model.predict(obs, deterministic=True)[0], expected, atol=1e-6)
    model.learn(25)
    assert not np.array_equal(model.predict(obs, deterministic=True)[0], expected)
