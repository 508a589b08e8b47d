"""Every algorithm and kind of space in every format: the artifact acts as ``predict`` does."""

import numpy as np
import onnxruntime
import pytest
import torch as th
from export.tools import VECTOR, OwnExtractor, Task
from gymnasium import spaces
from support import ALGORITHMS, TinyImages, make

from sb3_sparse.export import FORMATS, export_policy
from sb3_sparse.export.compiler import compiled
from sb3_sparse.export.extract import graph_of
from sb3_sparse.export.numpy_policy import Policy

TWO_AXES = spaces.Box(
    np.array([[-1, 0.5], [-3, 2]], np.float32), np.array([[1, 0.7], [-2, 9]], np.float32)
)


def trained(algorithm, env=None, **arguments):
    model = make(algorithm, env, **arguments)
    model.learn(40)
    if hasattr(model, "exploration_rate"):
        favour_no_action(model)
    return model


def favour_no_action(model):
    """Take what all observations have in common off the scores, or one action is always best."""
    scores = graph_of(model, None).values(observations_of(model))[-2].mean(axis=1)
    network = getattr(model, "q_net", None) or model.quantile_net
    bias = getattr(network, "q_net", None) or network.quantile_net
    bias[-1].bias.data -= th.as_tensor(np.resize(scores, len(bias[-1].bias)))


def observations_of(model, count=50):
    space = model.observation_space
    if space.dtype == np.uint8:
        space.seed(1)
        return np.stack([space.sample() for _ in range(count)])
    return np.random.default_rng(1).normal(size=(count, *space.shape)).astype(np.float32)


def act(path, to, model, observations):
    """Actions of what was written, run as a user would."""
    if to == "c":
        return compiled(path.with_suffix(".c").read_text(), graph_of(model, None))(observations)
    if to == "numpy":
        return Policy(path.with_suffix(".npz"))(observations)
    if to == "onnx":
        session = onnxruntime.InferenceSession(path.with_suffix(".onnx"))
        kind = np.uint8 if observations.dtype == np.uint8 else np.float32
        return session.run(["action"], {"obs": observations.astype(kind)})[0]
    loaded = type(model).load(path.with_suffix(".zip"))
    assert type(loaded.policy).__module__.startswith(("stable_baselines3", "sb3_contrib"))
    return loaded.predict(observations, deterministic=True)[0]


def check(model, folder, to):
    report = export_policy(model, folder / "policy", to)
    assert report.parity.holds, to
    observations = observations_of(model)
    expected, _ = model.predict(observations, deterministic=True)
    found = act(folder / "policy", to, model, observations)
    if to != "c":
        assert found.shape == expected.shape, to
    apart = np.abs(found.reshape(len(found), -1) - expected.reshape(len(expected), -1))
    assert apart.max() <= (1e-5 if isinstance(model.action_space, spaces.Box) else 0), to
    assert len(np.unique(expected.reshape(len(expected), -1), axis=0)) > 1  # it does act
    return report


@pytest.mark.parametrize("algorithm", ALGORITHMS.values(), ids=ALGORITHMS)
def test_sparse_policies(algorithm, tmp_path):
    model = trained(algorithm, policy_kwargs={"sparsity": 0.7})
    for to in FORMATS:
        assert check(model, tmp_path, to).parity.random == 1000


@pytest.mark.parametrize("compute", ["masked", "sparse"])
@pytest.mark.parametrize("algorithm", sorted({*ALGORITHMS} - {"CrossQ"}))
def test_simba_networks(algorithm, compute, tmp_path):
    kwargs = dict(sparsity=0.7, compute=compute, net_arch=[16, 16])
    model = trained(algorithm, policy="SparseSimbaPolicy", policy_kwargs=kwargs)
    draw_norms(model)
    if hasattr(model, "exploration_rate"):
        favour_no_action(model)
    for to in ("c", "numpy", "onnx"):
        check(model, tmp_path, to)


def draw_norms(model):
    """Give every unit of a LayerNorm another scale and shift; training begins with 1 and 0."""
    th.manual_seed(0)
    for module in model.policy.modules():
        if isinstance(module, th.nn.LayerNorm):
            module.weight.data.uniform_(0.5, 2.0)
            module.bias.data.normal_()


@pytest.mark.parametrize("algorithm", ["DQN", "SAC", "PPO", "TD3", "CrossQ", "QRDQN"])
def test_stock_policies(algorithm, tmp_path):
    model = trained(algorithm, policy="MlpPolicy")
    for to in FORMATS:
        check(model, tmp_path, to)


@pytest.mark.parametrize("to", FORMATS)
@pytest.mark.parametrize(
    "space",
    [
        spaces.MultiDiscrete([3, 2, 4]),
        spaces.MultiBinary(3),
        TWO_AXES,
    ],
    ids=["MultiDiscrete", "MultiBinary", "2x2"],
)
def test_action_spaces(space, to, tmp_path):
    model = make("PPO", Task(VECTOR, space))
    model.policy.action_net.weight.data.mul_(100)  # or all actions are the same
    check(model, tmp_path, to)


def test_a_squashed_box_of_two_axes(tmp_path):
    check(trained("SAC", Task(VECTOR, TWO_AXES)), tmp_path, "c")


@pytest.mark.parametrize("compute", ["masked", "sparse"])
@pytest.mark.parametrize("algorithm", ["DQN", "SAC"])
def test_images(algorithm, compute, tmp_path):
    kwargs = {"sparsity": 0.7, "compute": compute}
    model = trained(algorithm, TinyImages(algorithm == "DQN"), policy_kwargs=kwargs)
    for to in FORMATS:
        assert check(model, tmp_path, to).parity.random == 100


@pytest.mark.parametrize("int8", [False, True])
def test_files_are_the_same_whatever_the_storage(int8, tmp_path):
    model = trained("DQN", TinyImages(), policy_kwargs={"sparsity": 0.7, "compute": "sparse"})
    export_policy(model, tmp_path / "sparse", int8=int8)
    model.policy.sparse.to_masked(model.policy)
    export_policy(model, tmp_path / "masked", int8=int8)
    one, other = ((tmp_path / f"{name}.c").read_text() for name in ("sparse", "masked"))
    assert one.replace("sparse", "masked") == other.replace("sparse", "masked")


@pytest.mark.parametrize("compute", ["masked", "sparse"])
def test_the_impala_network_with_its_residual_connections(compute, tmp_path):
    kwargs = dict(
        features_extractor_class="sb3_sparse.networks.ImpalaCNN",
        features_extractor_kwargs=dict(channels=(4, 8, 8), features_dim=32),
        sparsity=0.6,
        compute=compute,
    )
    model = make("PPO", TinyImages(False), policy_kwargs=kwargs)
    for to in ("c", "numpy", "onnx"):
        check(model, tmp_path, to)


def test_gsde_of_ppo(tmp_path):
    model = trained("PPO", use_sde=True, policy_kwargs=dict(squash_output=True))
    for to in FORMATS:
        check(model, tmp_path, to)


def test_gsde_of_sac_with_its_clipped_mean(tmp_path):
    check(trained("SAC", use_sde=True), tmp_path, "c")


@pytest.mark.parametrize("activation", ["LeakyReLU", "ELU", "Tanh", "Sigmoid", "SiLU"])
def test_activations(activation, tmp_path):
    kwargs = dict(activation_fn=f"torch.nn.{activation}", sparsity=0.5)
    model = make("SAC", policy_kwargs=kwargs)
    for to in ("c", "numpy", "onnx"):
        check(model, tmp_path, to)


def test_an_extractor_of_ones_own(tmp_path):
    kwargs = dict(features_extractor_class=OwnExtractor, sparsity=0.5)
    model = trained("PPO", Task(VECTOR, spaces.Discrete(4)), policy_kwargs=kwargs)
    for to in ("c", "numpy", "onnx"):
        check(model, tmp_path, to)


def test_separate_extractors_of_ppo(tmp_path):
    kwargs = dict(share_features_extractor=False, features_extractor_class=OwnExtractor)
    check(trained("PPO", policy_kwargs=kwargs), tmp_path, "c")


def test_an_actor_without_hidden_layers(tmp_path):
    model = trained("PPO", policy_kwargs=dict(net_arch=[], sparsity=0.2))
    for to in FORMATS:
        check(model, tmp_path, to)


def test_a_policy_that_computes_on_its_non_zeros(tmp_path):
    model = trained("SAC", policy_kwargs=dict(compute="sparse"))
    assert all(layer.is_sparse for layer in model.policy.sparse.layers)
    check(model, tmp_path, "c")
    check(model, tmp_path, "dense")
