"""Policies in sparse storage, seen by torch's tracers as SB3's documentation has it."""

import io

import numpy as np
import onnx
import onnxruntime
import pytest
import torch as th
from support import ALGORITHMS, TinyImages, make
from torch import nn

BATCHES = (1, 5, 70)  # tiles hold 64


class Deterministic(nn.Module):
    """What SB3's documentation exports."""

    def __init__(self, acting):
        super().__init__()
        self.acting = acting

    def forward(self, observation):
        return self.acting(observation, deterministic=True)


@pytest.fixture(params=[nn.ReLU, nn.Tanh], ids=["ReLU", "Tanh"])
def activation(request):
    return request.param


@pytest.fixture(params=["SAC", "TD3", "DQN", "PPO", "CrossQ", "DQN on images", "SAC on images"])
def network(request, activation):
    name, _, images = request.param.partition(" on ")
    kwargs = dict(compute="sparse", activation_fn=activation)
    env = TinyImages(discrete=name == "DQN") if images else None
    policy = make(ALGORITHMS[name], env, policy_kwargs=kwargs).policy
    assert all(layer.is_sparse for layer in policy.sparse.layers)
    acting = getattr(policy, "actor", None) or getattr(policy, "q_net", None) or policy
    direct = name in ("TD3", "DQN")
    return (acting if direct else Deterministic(acting)).eval()


def seen(network, batch):
    first = next(m for m in network.modules() if isinstance(m, (nn.Linear, nn.Conv2d)))
    shape = (first.in_features,) if isinstance(first, nn.Linear) else (1, 36, 36)
    noise = np.random.default_rng(batch).normal(size=(batch, *shape))
    return th.as_tensor(noise, dtype=th.float32)


def tensors(result):
    return result if isinstance(result, tuple) else (result,)


def assert_same(found, expected):
    for one, other in zip(tensors(found), tensors(expected), strict=True):
        np.testing.assert_allclose(
            np.asarray(one.detach()), np.asarray(other.detach()), atol=1e-6, rtol=1e-5
        )


@pytest.mark.filterwarnings("ignore")
def test_the_onnx_exporter_takes_them_for_every_batch(network):
    file = io.BytesIO()
    th.onnx.export(
        network, (seen(network, 2),), file, dynamo=False,
        input_names=["obs"], dynamic_axes={"obs": {0: "batch"}},
    )  # fmt: skip
    written = onnx.load_from_string(file.getvalue())
    assert not {"ScatterND", "Pad"} & {node.op_type for node in written.graph.node}
    session = onnxruntime.InferenceSession(file.getvalue())
    for batch in BATCHES:
        observations = seen(network, batch)
        found = tuple(map(th.as_tensor, session.run(None, {"obs": observations.numpy()})))
        with th.no_grad():
            assert_same(found, network(observations))


@pytest.mark.filterwarnings("ignore")
def test_jit_takes_them_for_every_batch(network):
    traced = th.jit.trace(network, seen(network, 2))
    for batch in BATCHES:
        assert_same(traced(seen(network, batch)), network(seen(network, batch)))


def test_functional_calls_with_other_parameters_and_their_gradients(network):
    observations = seen(network, 5)
    parameters = {name: 0.5 * value.detach() for name, value in network.named_parameters()}

    def loss(parameters):
        result = th.func.functional_call(network, parameters, (observations,))
        return tensors(result)[-1].sum()

    value, gradients = loss(parameters), th.func.grad(loss)(parameters)
    with th.no_grad():
        for name, parameter in network.named_parameters():
            parameter.copy_(parameters[name])
    expected = tensors(network(observations))[-1].sum()
    assert float(value.detach()) == pytest.approx(float(expected.detach()), rel=1e-5, abs=1e-6)
    expected.backward()
    assert any(gradient.any() for gradient in gradients.values())
    for name, parameter in network.named_parameters():
        own = th.zeros_like(parameter) if parameter.grad is None else parameter.grad
        np.testing.assert_allclose(gradients[name], own, atol=1e-5, rtol=1e-4)


def test_torch_export_takes_a_network_without_distributions():
    network = make("TD3", policy_kwargs=dict(compute="sparse")).policy.actor.eval()
    exported = th.export.export(network, (seen(network, 3),)).module()
    assert_same(exported(seen(network, 3)), network(seen(network, 3)))


@pytest.mark.filterwarnings("ignore")
def test_a_part_of_an_actor_is_exported_too():
    actor = make("SAC", policy_kwargs=dict(compute="sparse")).policy.actor
    network = nn.Sequential(actor.latent_pi, actor.mu, nn.Tanh())
    file = io.BytesIO()
    th.onnx.export(network, (seen(network, 1),), file, dynamo=False, input_names=["obs"])
    session = onnxruntime.InferenceSession(file.getvalue())
    found = session.run(None, {"obs": seen(network, 1).numpy()})[0]
    assert_same(th.as_tensor(found), network(seen(network, 1)))
