"""Sparse SimBa policies of every algorithm that has one."""

from __future__ import annotations

import copy
import math

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3
import torch as th
from algorithms_support import NAMES as FUSED
from algorithms_support import assert_like_stock, moving, policy_kwargs_of
from support import ALGORITHMS, DISCRETE, TinyDicts, TinyImages, assert_masked, make
from torch import nn

import sb3_sparse
from sb3_sparse import SparsityCallback
from sb3_sparse.engine.inference import Inference
from sb3_sparse.engine.residual import Residual
from sb3_sparse.errors import ConfigError

NAMES = sorted(
    name for name, cls in ALGORITHMS.items() if "SparseSimbaPolicy" in cls.policy_aliases
)
ON_POLICY = ("PPO", "A2C", "TRPO")
STORAGES = ["masked", "sparse"]


def arch_of(name: str, width: int = 16) -> object:
    if name in DISCRETE:
        return [width, width]
    return {"pi": [width], "vf" if name in ON_POLICY else "qf": [width, width]}


def simba(name: str, env=None, compute: str = "auto", **kwargs):
    policy_kwargs = {
        "net_arch": arch_of(name),
        "compute": compute,
        **kwargs.pop("policy_kwargs", {}),
    }
    return make(name, env, "SparseSimbaPolicy", policy_kwargs, **kwargs)


def test_the_algorithms_that_have_one():
    assert set(NAMES) == set(ALGORITHMS) - {"CrossQ"}


@pytest.mark.parametrize("compute", STORAGES)
@pytest.mark.parametrize("name", NAMES)
def test_training_keeps_counts_and_zeros_and_moves_masks(name, compute):
    model = simba(name, compute=compute)
    layers = list(model.policy.sparse.layers)
    before = [(layer.mask(), layer.nnz) for layer in layers]
    model.learn(100, callback=SparsityCallback("rigl", update_interval=5))
    assert_masked(model)
    layers = list(model.policy.sparse.layers)
    assert [layer.nnz for layer in layers] == [nnz for _, nnz in before]
    assert any(
        (layer.mask() != mask).any() for layer, (mask, _) in zip(layers, before, strict=True)
    )
    norms = [m for m in model.policy.modules() if isinstance(m, nn.LayerNorm)]
    assert norms
    assert any((norm.weight != 1).any() for norm in norms)


@pytest.mark.parametrize("compute", STORAGES)
@pytest.mark.parametrize("name", NAMES)
def test_a_saved_model_acts_and_trains_as_before(name, compute, tmp_path):
    model = simba(name, compute=compute)
    model.learn(64, callback=SparsityCallback("set", update_interval=5))
    model.save(tmp_path / "model")
    loaded = ALGORITHMS[name].load(tmp_path / "model", env=model.get_env())
    twin = copy.deepcopy(model.policy)
    observation = np.stack([model.observation_space.sample() for _ in range(3)])
    expected, _ = model.predict(observation, deterministic=True)
    np.testing.assert_array_equal(loaded.predict(observation, deterministic=True)[0], expected)
    np.testing.assert_array_equal(twin.predict(observation, deterministic=True)[0], expected)
    one, two = model.policy.state_dict(), loaded.policy.state_dict()
    assert one.keys() == two.keys()
    for key, value in one.items():
        assert th.equal(th.as_tensor(value), th.as_tensor(two[key])), key
    loaded.learn(40, callback=SparsityCallback("set", update_interval=5))
    assert_masked(loaded)


@pytest.mark.parametrize("name", NAMES)
def test_equal_seeds_give_equal_runs(name):
    models = [simba(name).learn(64) for _ in range(2)]
    for one, two in zip(*(model.policy.parameters() for model in models), strict=True):
        assert th.equal(one, two)


@pytest.mark.parametrize("method", ["static", "rigl", "prune", "dense"])
@pytest.mark.parametrize("name", FUSED)
def test_fused_steps_end_as_those_of_stock(name, method):
    for storage in STORAGES:
        kwargs = dict(policy_kwargs_of(method, storage), net_arch=arch_of(name))
        # Where the epsilon is small, what has no gradient moves by the learning rate times noise.
        kwargs["optimizer_kwargs"] = dict(eps=1e-3)
        assert_like_stock(
            name, lambda: moving(method), policy="SparseSimbaPolicy", policy_kwargs=kwargs
        )


@pytest.mark.parametrize("compute", STORAGES)
@pytest.mark.parametrize("name", NAMES)
def test_the_kernels_act_as_the_modules_do(name, compute):
    model = simba(name, compute=compute)
    th.manual_seed(0)
    for parameter in model.policy.parameters():
        parameter.data.add_(0.1 * th.randn_like(parameter))
    policy = model.policy
    policy.sparse.enforce()
    acting = [policy.get_submodule(path) for path in type(policy).acting[1:]]
    inference = Inference.of([acting])
    assert inference is not None
    size = next(m for m in acting[0].modules() if isinstance(m, nn.Linear)).in_features
    for n in (1, 3, 16):
        x = th.randn(n, size)
        with th.no_grad():
            found, expected = inference(x), x
            for module in acting:
                expected = module(expected)
        th.testing.assert_close(found[0], expected, rtol=1e-4, atol=1e-5)


def test_a_norm_without_parameters_and_a_shortcut_to_the_observations():
    net = nn.Sequential(
        Residual(nn.LayerNorm(6, elementwise_affine=False), nn.Linear(6, 6), nn.Tanh()),
        nn.LayerNorm(6, bias=False),
        nn.Linear(6, 2),
    )
    nn.init.normal_(net[1].weight)
    inference = Inference.of([[net]])
    for n in (1, 7):
        x = 3 * th.randn(n, 6) + 1
        with th.no_grad():
            th.testing.assert_close(inference(x)[0], net(x), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    "net",
    [
        nn.Sequential(nn.LayerNorm(4), nn.LayerNorm(4), nn.Linear(4, 2)),
        nn.Sequential(nn.LayerNorm((2, 2)), nn.Linear(4, 2)),
        nn.Sequential(nn.Linear(4, 4), nn.LayerNorm(4)),
        nn.Sequential(nn.Linear(4, 4), nn.LayerNorm(4), nn.ReLU(), nn.Linear(4, 2)),
        nn.Sequential(nn.LayerNorm(4), Residual(nn.Linear(4, 4)), nn.Linear(4, 2)),
        nn.Sequential(nn.Linear(4, 4), Residual(nn.Identity()), nn.Linear(4, 2)),
        nn.Sequential(nn.Linear(4, 4), Residual(nn.Linear(4, 4)), nn.ReLU(), nn.Linear(4, 2)),
        nn.Sequential(nn.Linear(4, 3), nn.LayerNorm(4), nn.Linear(4, 2)),
        nn.Sequential(nn.Linear(4, 3), Residual(nn.Linear(3, 1)), nn.Linear(1, 2)),
    ],
)
def test_what_the_kernels_leave_to_the_modules(net):
    assert Inference.of([[net]]) is None


@pytest.mark.parametrize("width", [64, 256])
def test_the_variance_of_sparse_weights_is_that_of_simba(width):
    """With active fans in place of those of the dense layers, where the mask is even."""
    kwargs = dict(sparsity=0.5, distribution="uniform", net_arch=dict(pi=[width], qf=[width]))
    model = make("SAC", "Pendulum-v1", "SparseSimbaPolicy", policy_kwargs=kwargs)
    for layer in model.policy.sparse.layers:
        if ".residual." in layer.name:
            values = layer.dense()[layer.mask()]
            expected = math.sqrt(2 / (0.5 * layer.shape[1]))
            assert values.std() == pytest.approx(expected, rel=0.05), layer.name


def test_dense_networks_start_as_simba_does():
    kwargs = dict(sparsity=0.0, net_arch=dict(pi=[64], vf=[64]))
    policy = make("PPO", "CartPole-v1", "SparseSimbaPolicy", policy_kwargs=kwargs).policy
    first, block = policy.mlp_extractor.policy_net[0], policy.mlp_extractor.policy_net[1]
    th.testing.assert_close(first.weight.T @ first.weight, th.eye(4), atol=1e-5, rtol=0)
    assert block.residual[1].weight.std().item() == pytest.approx(math.sqrt(2 / 64), rel=0.05)
    norm = th.linalg.matrix_norm(policy.action_net.weight, ord=2)
    assert norm.item() == pytest.approx(0.01, rel=1e-4)  # SB3's ortho_init of the output


def test_decoupled_decay_acts_on_norms_and_biases_and_leaves_zeros():
    model = simba(
        "SAC", learning_rate=1e-2, policy_kwargs=dict(optimizer_kwargs=dict(weight_decay=0.5))
    )
    optimizer = model.policy.actor.optimizer
    assert type(optimizer) is th.optim.AdamW
    norm = model.policy.actor.latent_pi[-1]
    for parameter in model.policy.actor.parameters():
        parameter.grad = th.zeros_like(parameter)
    optimizer.step()
    th.testing.assert_close(norm.weight, th.full_like(norm.weight, 1 - 1e-2 * 0.5))
    assert_masked(model)


@pytest.mark.parametrize("name", ["SAC", "DQN", "PPO"])
@pytest.mark.parametrize("env", [TinyImages, TinyDicts])
def test_images_and_dicts(name, env):
    model = simba(name, env(discrete=name != "SAC"))
    model.learn(40)
    assert_masked(model)
    model.predict(model.observation_space.sample())


@pytest.mark.parametrize("name", ["SAC", "TQC", "TD3", "DQN", "QRDQN"])
def test_an_actor_saved_alone_is_loaded_by_its_own_class(name, tmp_path):
    model = simba(name).learn(40)
    part = type(model.policy).acting[0].split(".")[0]
    acting = getattr(model.policy, part)
    acting.save(tmp_path / "part")
    loaded = type(acting).load(tmp_path / "part")
    observation = model.observation_space.sample()
    expected, _ = acting.predict(observation, deterministic=True)
    np.testing.assert_allclose(
        loaded.predict(observation, deterministic=True)[0], expected, atol=1e-6
    )


def test_gsde():
    model = simba("SAC", use_sde=True).learn(40)
    assert_masked(model)


@pytest.mark.parametrize("name", NAMES)
def test_no_blocks_or_several_widths(name):
    for arch in ([], [8, 16]):
        with pytest.raises(ConfigError, match="one entry for each of its blocks"):
            simba(name, policy_kwargs=dict(net_arch=arch))


def test_stock_algorithms_take_it_by_name():
    env = gym.make("Pendulum-v1")
    model = stable_baselines3.SAC(
        sb3_sparse.SparseSimbaPolicy, env, policy_kwargs=dict(sparsity=0.8)
    )
    widths = [q[0].out_features for q in model.critic.q_networks]
    assert (model.actor.latent_pi[0].out_features, widths) == (128, [256, 256])
