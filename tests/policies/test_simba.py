"""Sparse SimBa policies of every algorithm that has one."""

from __future__ import annotations

import copy
import math
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3
import torch as th
from algorithms_support import NAMES as FUSED_ALGORITHMS
from algorithms_support import assert_alike, assert_like_stock, learn, moving, policy_kwargs_of
from algorithms_support import make as make_alike
from simba_support import simba_by_hand
from support import ALGORITHMS, DISCRETE, TinyDicts, TinyImages, assert_masked, make
from torch import nn

import sb3_sparse
from sb3_sparse import RecycleDormantCallback, ResetCallback, SparsityCallback
from sb3_sparse.engine.inference import Inference
from sb3_sparse.engine.residual import Residual
from sb3_sparse.errors import ConfigError, UnsupportedError

NAMES = sorted(
    name
    for name, cls in ALGORITHMS.items()
    if isinstance(cls.policy_aliases.get("SparseSimbaPolicy"), type)
)
FUSED = [name for name in FUSED_ALGORITHMS if name in NAMES]
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
    with pytest.raises(UnsupportedError, match="CrossQ has no SparseSimbaPolicy; it is there for"):
        make("CrossQ", policy="SparseSimbaPolicy")
    with pytest.raises(UnsupportedError, match="CrossQ has no SparseSimbaPolicy; it is there for"):
        sb3_sparse.CrossQ("SparseSimbaPolicy", "Pendulum-v1")


@pytest.mark.parametrize("compute", STORAGES)
@pytest.mark.parametrize("name", NAMES)
def test_training_keeps_counts_and_zeros_and_moves_masks(name, compute):
    model = simba(name, compute=compute)
    layers = list(model.policy.sparse.layers)
    before = [(layer.mask(), layer.nnz) for layer in layers]
    model.learn(64, callback=SparsityCallback("rigl", update_interval=5))
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
    model.learn(40, callback=SparsityCallback("set", update_interval=4))
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
    loaded.learn(30, callback=SparsityCallback("set", update_interval=4))
    assert_masked(loaded)


@pytest.mark.parametrize("name", NAMES)
def test_equal_seeds_give_equal_runs(name):
    models = [simba(name).learn(40) for _ in range(2)]
    for one, two in zip(*(model.policy.parameters() for model in models), strict=True):
        assert th.equal(one, two)


@pytest.mark.parametrize("method", ["static", "rigl", "prune", "dense"])
@pytest.mark.parametrize("name", FUSED)
def test_fused_steps_end_as_those_of_stock(name, method):
    for storage in STORAGES:
        # Smooth: where a ReLU's input is 0 but for rounding, one of the two has no gradient.
        smooth = dict(net_arch=arch_of(name), activation_fn=nn.SiLU)
        kwargs = dict(policy_kwargs_of(method, storage), **smooth)
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


def test_a_residual_within_a_residual():
    inner = Residual(nn.LayerNorm(6), nn.Linear(6, 6), nn.Tanh())
    net = nn.Sequential(
        nn.Linear(4, 6), Residual(nn.Linear(6, 6), inner, nn.Linear(6, 6)), nn.Linear(6, 2)
    )
    x = th.randn(5, 4)
    with th.no_grad():
        th.testing.assert_close(Inference.of([[net]])(x)[0], net(x), rtol=1e-5, atol=1e-6)


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
        nn.Sequential(nn.Linear(4, 4), Residual(nn.ReLU(), nn.Linear(4, 4)), nn.Linear(4, 2)),
        nn.Sequential(nn.Linear(4, 3), nn.LayerNorm(4), nn.Linear(4, 2)),
        nn.Sequential(nn.Linear(4, 3), Residual(nn.Linear(3, 1)), nn.Linear(1, 2)),
    ],
)
def test_what_the_kernels_leave_to_the_modules(net):
    assert Inference.of([[net]]) is None


@pytest.mark.parametrize(
    ("sparsity", "compute"), [(0.0, "masked"), (0.8, "masked"), (0.8, "sparse")]
)
def test_a_critic_is_the_network_of_the_paper(sparsity, compute):
    model = simba("SAC", compute=compute, policy_kwargs=dict(sparsity=sparsity)).learn(40)
    obs, actions = th.randn(70, 3), th.rand(70, 1)
    x = th.cat([obs, actions], dim=1).requires_grad_()
    saved = model.policy.state_dict().items()
    weights = {k.removeprefix("critic.qf0."): v for k, v in saved if k.startswith("critic.qf0.")}
    expected = simba_by_hand(weights, 2, x)
    (slope,) = th.autograd.grad(expected.sum(), x)
    found = model.critic(obs, actions.requires_grad_())[0]
    th.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
    found.sum().backward()
    th.testing.assert_close(actions.grad, slope[:, 3:], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", FUSED)
def test_coupled_decay_and_clipping_beside_norms(name):
    kwargs = dict(sparsity=0.7, net_arch=arch_of(name), weight_decay=0.05)
    kwargs["optimizer_kwargs"] = dict(eps=1e-3)
    clipped = {} if name in ("SAC", "TD3", "DDPG", "TQC") else {"max_grad_norm": 0.01}
    ours, _ = assert_like_stock(
        name, lambda: moving("rigl"), policy="SparseSimbaPolicy", policy_kwargs=kwargs, **clipped
    )
    optimizer = ours.policy.sparse.optimizers[0]
    assert name == "A2C" or optimizer.param_groups[0]["weight_decay"] == 0.0


@pytest.mark.parametrize("name", NAMES)
def test_defaults(name):
    few = {"n_quantiles": 20} if name == "QRDQN" else {}
    model = simba(name, policy_kwargs=dict(net_arch=None, **few))
    group = model.policy.sparse.optimizers[0].param_groups[0]
    if name not in ("A2C", "QRDQN"):  # which hand over an optimizer of their own
        assert type(model.policy.sparse.optimizers[0]) is th.optim.AdamW
        assert group["weight_decay"] == 0.01
        assert group["eps"] == (1e-5 if name in ON_POLICY else 1e-8)
    widths = {m[0].normalized_shape[0] for m in residuals(model.policy)}
    assert widths == ({256} if name in DISCRETE else {128, 256})


def residuals(policy):
    return [m.residual for m in policy.modules() if isinstance(m, Residual)]


def test_an_activation_with_its_arguments():
    slope = partial(nn.LeakyReLU, 0.3)
    model = simba("SAC", policy_kwargs=dict(activation_fn=slope))
    assert {block[2].negative_slope for block in residuals(model.policy)} == {0.3}


def test_an_epsilon_that_changes_is_followed():
    kwargs = dict(net_arch=[16, 16], optimizer_kwargs=dict(eps=1e-3))
    models = []
    for library in (sb3_sparse, stable_baselines3):
        model = make_alike(library, "SAC", policy="SparseSimbaPolicy", policy_kwargs=kwargs)
        observation = learn(model).observation_space.sample()
        before, _ = model.predict(observation, deterministic=True)
        for module in model.policy.modules():
            if isinstance(module, nn.LayerNorm):
                module.eps = 3.0
        acted, _ = model.predict(observation, deterministic=True)
        assert np.abs(acted - before).max() > 1e-3
        with th.no_grad():
            latent = model.actor.latent_pi(th.as_tensor(observation[None]))
            expected = model.actor.mu(latent).tanh()[0]
        np.testing.assert_allclose(acted, expected, atol=1e-5)
        models.append(learn(model))
    assert_alike(*models)


@pytest.mark.parametrize("width", [64, 256])
def test_the_variance_of_sparse_weights_is_that_of_simba(width):
    """With active fans in place of those of the dense layers, where the mask is even."""
    kwargs = dict(sparsity=0.5, distribution="uniform", net_arch=dict(pi=[width], qf=[width]))
    model = make("SAC", "Pendulum-v1", "SparseSimbaPolicy", policy_kwargs=kwargs)
    for layer in model.policy.sparse.layers:
        values = layer.dense()[layer.mask()]
        if ".residual." in layer.name:
            expected = math.sqrt(2 / (0.5 * layer.shape[1]))
        else:
            expected = math.sqrt(1 / (0.5 * max(layer.shape)))
        few = 0.05 if values.size > 1000 else 0.4
        assert values.std() == pytest.approx(expected, rel=few), layer.name


def test_dense_networks_start_as_simba_does():
    kwargs = dict(sparsity=0.0, net_arch=dict(pi=[64], vf=[64]))
    policy = make("PPO", "CartPole-v1", "SparseSimbaPolicy", policy_kwargs=kwargs).policy
    first, block = policy.mlp_extractor.policy_net[0], policy.mlp_extractor.policy_net[1]
    th.testing.assert_close(first.weight.T @ first.weight, th.eye(4), atol=1e-5, rtol=0)
    assert block.residual[1].weight.std().item() == pytest.approx(math.sqrt(2 / 64), rel=0.05)
    norm = th.linalg.matrix_norm(policy.action_net.weight, ord=2)
    assert norm.item() == pytest.approx(0.01, rel=1e-4)  # SB3's ortho_init of the output
    kwargs["ortho_init"] = False
    policy = make("PPO", "CartPole-v1", "SparseSimbaPolicy", policy_kwargs=kwargs).policy
    for head in (policy.action_net, policy.value_net):
        assert th.linalg.matrix_norm(head.weight, ord=2).item() == pytest.approx(1.0, rel=1e-4)
        assert not head.bias.any()


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
    assert model.action_space.contains(model.predict(model.observation_space.sample())[0])


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
    observation = model.observation_space.sample()
    acted, _ = model.actor.predict(observation, deterministic=True)
    with th.no_grad():
        expected = model.actor.mu(model.actor.latent_pi(th.as_tensor(observation[None]))).tanh()
    np.testing.assert_allclose(acted, 2 * expected[0], atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_no_blocks_or_several_widths(name):
    for arch in ([], [8, 16]):
        with pytest.raises(ConfigError, match="one entry for each of its blocks"):
            simba(name, policy_kwargs=dict(net_arch=arch))


@pytest.mark.parametrize("compute", STORAGES)
@pytest.mark.parametrize("name", ["SAC", "TD3", "DQN", "TQC"])
def test_recycled_units_and_resets(name, compute):
    callbacks = [
        SparsityCallback("rigl", update_interval=4),
        RecycleDormantCallback(5, tau=0.8, batch_size=32),
        ResetCallback(20),
    ]
    model = simba(name, compute=compute).learn(45, callback=callbacks)
    assert_masked(model)
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())
    assert model.resets_up_to >= 20


@pytest.mark.parametrize(
    ("name", "arch"),
    [
        ("PPO", {"pi": [8], "qf": [8]}),
        ("SAC", {"pi": [8], "vf": [8]}),
        ("SAC", {"pi": [8]}),
        ("DQN", {"qf": [8]}),
        ("TD3", 128),
    ],
)
def test_forms_of_net_arch_that_do_not_fit(name, arch):
    with pytest.raises(ConfigError, match=r"list with an entry for each block.*; got"):
        simba(name, policy_kwargs=dict(net_arch=arch))


def test_stock_algorithms_take_it_by_name():
    env = gym.make("Pendulum-v1")
    model = stable_baselines3.SAC(
        sb3_sparse.SparseSimbaPolicy, env, policy_kwargs=dict(sparsity=0.8)
    )
    widths = [q[0].out_features for q in model.critic.q_networks]
    assert (model.actor.latent_pi[0].out_features, widths) == (128, [256, 256])
