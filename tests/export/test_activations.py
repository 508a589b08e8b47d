"""Torch's activations, in every format, at every magnitude."""

import warnings
from functools import partial

import numpy as np
import pytest
import torch as th
from export.tools import VECTOR, OwnExtractor, Task
from gymnasium import spaces
from support import make
from torch import nn

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export import export_policy
from sb3_sparse.export.activations import FORMULAS
from sb3_sparse.export.artifact import GRAPH_ARTIFACTS
from sb3_sparse.export.fold import fold
from sb3_sparse.export.graph import Graph
from sb3_sparse.export.nodes import Standardize
from sb3_sparse.export.trace import Tracer

UNITS = 6
ACTIVATIONS = {
    "ReLU": nn.ReLU(),
    "LeakyReLU": nn.LeakyReLU(0.3),
    "PReLU": nn.PReLU(init=0.4),
    "PReLU of units": nn.PReLU(UNITS),
    "RReLU": nn.RReLU(0.1, 0.5),
    "ELU": nn.ELU(0.7),
    "SELU": nn.SELU(),
    "CELU": nn.CELU(2.5),
    "Tanh": nn.Tanh(),
    "Sigmoid": nn.Sigmoid(),
    "SiLU": nn.SiLU(),
    "GELU": nn.GELU(),
    "GELU by tanh": nn.GELU("tanh"),
    "Mish": nn.Mish(),
    "Softplus": nn.Softplus(),
    "steep Softplus": nn.Softplus(3.0, 1.0),
    "LogSigmoid": nn.LogSigmoid(),
    "Softsign": nn.Softsign(),
    "Hardswish": nn.Hardswish(),
    "Hardsigmoid": nn.Hardsigmoid(),
    "Hardtanh": nn.Hardtanh(-0.3, 2.0),
    "ReLU6": nn.ReLU6(),
    "Tanhshrink": nn.Tanhshrink(),
    "Softshrink": nn.Softshrink(0.7),
    "Hardshrink": nn.Hardshrink(0.7),
    "Threshold": nn.Threshold(0.1, -5.0),
    "Identity": nn.Identity(),
}
FAR = [10.0**n for n in (-30, -6, 1, 2, 3, 6, 20, 37)] + [50.0, 87.0, 88.0, 89.0, 200.0]
NUMBERS = np.float32([*np.linspace(-12, 12, 93), *FAR, *(-x for x in FAR), 0.0])


def test_all_of_them_are_tried():
    assert {type(module) for module in ACTIVATIONS.values()} == set(FORMULAS)


@pytest.mark.parametrize("image", [False, True], ids=["vector", "image"])
@pytest.mark.parametrize("name", ACTIVATIONS)
def test_each_format_computes_what_torch_does(name, image):
    module = ACTIVATIONS[name].eval()
    if name == "PReLU of units":
        module.weight.data = th.linspace(-0.5, 1.5, UNITS)
    x = NUMBERS.reshape(-1, UNITS, *[1] * (2 * image))
    with th.no_grad():
        expected = module(th.as_tensor(x)).numpy().reshape(-1, UNITS).astype(np.float64)
    tracer = Tracer(x.shape[1:])
    value = tracer.walk(nn.Flatten(), tracer.walk(module, 0))
    tracer.walk(nn.Hardtanh(-3e38, 3e38), value)  # as a Box does
    graph = fold(Graph(x.shape[1:], tracer.finish(), (UNITS,)))
    written = [make(graph, False) for make in GRAPH_ARTIFACTS.values()]
    for act in (graph.run, *(artifact.actor() for artifact in written)):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = act(x).astype(np.float64)
        apart = np.abs(found - expected) / np.maximum(1.0, np.abs(expected))
        assert apart.max() < 2e-6


POLICIES = [("SAC", "c"), ("PPO", "numpy"), ("TD3", "onnx"), ("DQN", "dense"), ("QRDQN", "c")]
OF_POLICIES = {
    "GELU": nn.GELU,
    "tanh": partial(nn.GELU, approximate="tanh"),
    "Mish": nn.Mish,
    "Softplus": partial(nn.Softplus, beta=2.0, threshold=3.0),
    "PReLU": nn.PReLU,
    "Hardswish": nn.Hardswish,
    "SELU": nn.SELU,
    "CELU": partial(nn.CELU, alpha=0.5),
    "LogSigmoid": nn.LogSigmoid,
    "Tanhshrink": nn.Tanhshrink,
}
PAIRS = [
    (name, *POLICIES[(number + further) % len(POLICIES)])
    for number, name in enumerate(OF_POLICIES)
    for further in (0, 1)
]
"""Each activation in two policies: what a format makes of it alone is tested above."""


@pytest.mark.parametrize(("name", "algorithm", "to"), PAIRS)
def test_whole_policies_act_as_the_model(name, algorithm, to, tmp_path):
    kwargs = dict(activation_fn=OF_POLICIES[name], sparsity=0.5)
    model = make(algorithm, policy_kwargs=kwargs)
    for parameter in model.policy.parameters():
        parameter.data.mul_(1.5)
    report = export_policy(model, tmp_path / "policy", to)
    assert report.parity.holds
    if to == "c":
        report = export_policy(model, tmp_path / "int8", "c", int8=True)
        assert report.parity.holds
        assert report.rounding is not None


def test_slopes_of_units_go_with_their_units(tmp_path):
    """Dead units are left out, and others sorted; each has its own slope."""
    kwargs = dict(activation_fn=partial(nn.PReLU, 24), sparsity=0.9)
    model = make("SAC", policy_kwargs=kwargs)
    for module in model.policy.modules():
        if isinstance(module, nn.PReLU):
            module.weight.data = th.linspace(-1.0, 2.0, 24)
    for to in ("c", "numpy", "onnx"):
        report = export_policy(model, tmp_path / "policy", to)
        assert report.parity.holds
        assert report.removed_units > 0


class Wild(OwnExtractor):
    """What people write in a forward."""

    def forward(self, observations):
        x = observations.float() / 2.0
        x = nn.functional.leaky_relu(self.first(2 * x - 1.0), 0.2)
        x = 1.0 - nn.functional.gelu(x, approximate="tanh")
        x = nn.functional.softplus(x, beta=2.0).clamp(-1, 3)
        x = nn.functional.dropout(x, training=self.training)
        return -self.second(x.view(x.size(0), -1)).reshape(x.shape[0], -1)


class Swish(nn.Module):
    def forward(self, x):
        return x * th.sigmoid(1.702 * x)


class SquaredReLU(nn.ReLU):
    def forward(self, x):
        return super().forward(x) ** 2 + th.square(0.1 * x)


@pytest.mark.parametrize("activation", [Swish, SquaredReLU])
@pytest.mark.parametrize("to", ["c", "numpy", "onnx"])
def test_activations_of_ones_own(activation, to, tmp_path):
    model = make("SAC", policy_kwargs=dict(activation_fn=activation, sparsity=0.5))
    assert export_policy(model, tmp_path / "policy", to).parity.holds


class Normed(OwnExtractor):
    """Layer normalisation as it is used before and behind an activation."""

    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.first = nn.Sequential(
            nn.Linear(5, 16), nn.LayerNorm(16), nn.Mish(), nn.LayerNorm(16, bias=False)
        )
        self.second = nn.LayerNorm(16, elementwise_affine=False)


@pytest.mark.parametrize("to", ["c", "numpy", "onnx"])
def test_layer_normalisation(to, tmp_path):
    kwargs = dict(features_extractor_class=Normed, sparsity=0.6)
    model = make("SAC", Task(VECTOR, spaces.Box(-1, 1, (2,))), policy_kwargs=kwargs)
    for module in model.policy.modules():
        if isinstance(module, nn.LayerNorm):
            for parameter in module.parameters():
                parameter.data.uniform_(-1, 2)
    assert export_policy(model, tmp_path / "policy", to).parity.holds


def test_a_layer_is_standardised_by_hand():
    # Mean 3, variance (4 + 0 + 4) / 3.
    graph = Graph((3,), (Standardize((0,), (3,), 1 / 3),), (3,))
    np.testing.assert_allclose(graph.run([[1, 3, 5]]), [[-2 / 3**0.5, 0, 2 / 3**0.5]], rtol=1e-6)


class Residual(nn.Sequential):
    def forward(self, x):
        return x + super().forward(x)


class Blocks(OwnExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.block = Residual(nn.utils.parametrizations.weight_norm(nn.Linear(16, 16)), nn.Mish())

    def forward(self, observations):
        return self.block(self.first(observations))


@pytest.mark.parametrize("extractor", [Wild, Blocks])
@pytest.mark.parametrize("to", ["c", "numpy", "onnx"])
def test_what_people_write_in_a_forward(extractor, to, tmp_path):
    kwargs = dict(features_extractor_class=extractor)
    model = make("PPO", Task(VECTOR, spaces.Box(-1, 1, (2,))), "MlpPolicy", policy_kwargs=kwargs)
    assert export_policy(model, tmp_path / "policy", to).parity.holds


class Noisy(nn.Linear):
    def forward(self, x):
        return nn.functional.linear(x, self.weight + 1.0, self.bias)


class WithNoisy(OwnExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.second = Noisy(16, 16)


class Grouped(OwnExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.second = nn.GroupNorm(2, 16)


class Sine(OwnExtractor):
    def forward(self, observations):
        return th.sin(self.first(observations))


class Twice(OwnExtractor):
    def forward(self, observations):
        return self.first(observations).view(-1, 32)


class AlwaysDropped(OwnExtractor):
    def forward(self, observations):
        return nn.functional.dropout(self.first(observations), 0.1)


@pytest.mark.parametrize(
    ("extractor", "message"),
    [
        (WithNoisy, r"features_extractor.second \(Noisy\) cannot be exported: .*; allowed are Lin"),
        (Grouped, r"features_extractor.second \(GroupNorm\) cannot be exported; allowed are Lin"),
        (Sine, r"features_extractor \(Sine\) .*: its forward calls sin\(\); allowed"),
        (Twice, r"features_extractor \(Twice\) .*: its forward calls view\(-1, 32\); allowed"),
        (AlwaysDropped, r"features_extractor \(AlwaysDropped\) .* calls dropout\("),
    ],
)
@pytest.mark.parametrize("to", ["c", "numpy", "onnx"])
def test_a_refusal_names_the_module(extractor, message, to, tmp_path):
    kwargs = dict(features_extractor_class=extractor)
    model = make("PPO", Task(VECTOR, spaces.Box(-1, 1, (2,))), "MlpPolicy", policy_kwargs=kwargs)
    with pytest.raises(UnsupportedError, match=message):
        export_policy(model, tmp_path / "policy", to)


@pytest.mark.filterwarnings("ignore:Implicit dimension")
def test_an_activation_that_cannot_be_exported_is_named_with_what_can(tmp_path):
    model = make("SAC", policy_kwargs=dict(activation_fn=nn.Softmax))
    with pytest.raises(UnsupportedError, match=r"^actor.latent_pi.1 \(Softmax\) cannot .*GELU"):
        export_policy(model, tmp_path / "policy")
