"""BatchRenorm in programs against sb3-contrib's, on one batch and on two at once."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_sparse.engine.controller import Controller
from sb3_sparse.engine.norms import is_warm
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.machine import Machine
from sb3_sparse.fused.parts import parts
from sb3_sparse.fused.program import Program
from sb3_sparse.policies.contrib import SoundBatchRenorm1d, renorms_of

FEATURES = 3


def network(warm, layers=(8,)):
    """Norms before all layers and behind the last, with running statistics of their own."""
    th.manual_seed(3)
    modules, width = [], FEATURES
    for rows in layers:
        modules += [SoundBatchRenorm1d(width), nn.Linear(width, rows), nn.ReLU()]
        width = rows
    made = nn.Sequential(*modules, SoundBatchRenorm1d(width))
    for norm in renorms_of(made):
        norm.warmup_steps, norm.steps[()] = 5, 6 if warm else 5
        with th.no_grad():
            for tensor in (norm.scale, norm.ra_var):
                tensor.uniform_(0.01, 1.5)
            for tensor in (norm.bias, norm.ra_mean):
                tensor.uniform_(-1, 1)
    return made


class Room:
    """A program of one step of size 1, on one batch or two."""

    def __init__(self, net, count, size, trains=True):
        self.optimizer = th.optim.SGD(net.parameters(), lr=1.0)
        program = Program()
        inputs = [program.input(f"x{i}", FEATURES) for i in range(count)]
        if trains:
            results = program.training_network(parts(net), *inputs)
        else:
            results = [program.network(parts(net), x) for x in inputs]
        loss = (results[0] - 0.3).square().mean()
        program.log("loss", loss)
        program.minimise(loss, self.optimizer)
        self.machine = Machine(program, Controller([], 0, False), size)

    def step(self, batches):
        self.machine.prepare()
        self.machine.load({f"x{i}": x for i, x in enumerate(batches)})
        self.machine.run()
        return self.machine.number("loss")


def reference(net, batches, trains=True):
    """The same step by torch, in float64; its loss."""
    net.double().train(trains)
    net.zero_grad()
    loss = (net(th.cat(batches).double())[: len(batches[0])] - 0.3).square().mean()
    loss.backward()
    with th.no_grad():
        for parameter in net.parameters():
            parameter -= parameter.grad
    return float(loss.detach())


def assert_same_step(net, batches, trains=True):
    twin = copy.deepcopy(net)
    loss = Room(net, len(batches), len(batches[0]), trains).step(batches)
    assert loss == pytest.approx(reference(twin, batches, trains), rel=1e-4)
    for (name, ours), theirs in zip(
        net.state_dict().items(), twin.state_dict().values(), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, rtol=2e-3, atol=2e-5, err_msg=name)


@pytest.mark.parametrize("size", [2, 63, 64, 65, 200, 600])
@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("warm", [False, True])
def test_a_step_equals_that_of_sb3_contrib(warm, count, size, instructions):
    random = th.Generator().manual_seed(size)
    net = network(warm)
    assert all(is_warm(norm) is warm for norm in renorms_of(net))
    assert_same_step(net, [th.randn(size, FEATURES, generator=random) * 3 for _ in range(count)])


@pytest.mark.parametrize("warm", [False, True])
def test_two_batches_of_one_entry_each(warm):
    assert_same_step(network(warm), [th.tensor([[0.5, -1.0, 2.0]]), th.tensor([[1.5, 0.0, 2.5]])])


def test_running_statistics_stay_outside_of_training():
    net = network(warm=True)
    before = {k: v.clone() for k, v in net.state_dict().items() if ".ra_" in k}
    assert_same_step(net, [th.randn(70, FEATURES)], trains=False)
    for name, tensor in before.items():
        assert th.equal(net.state_dict()[name], tensor)


@pytest.mark.parametrize("size", [3, 70, 200])
def test_constant_features_become_0_exactly_and_get_no_gradient(size):
    for warm in (False, True):
        net = network(warm, layers=())
        (norm,) = renorms_of(net)
        linear = nn.Linear(FEATURES, FEATURES)
        with th.no_grad():
            linear.weight[1] = 0.0
            linear.bias[1] = 0.1  # no float32, so that sums of it round
            norm.ra_mean[1], norm.ra_var[1] = 0.1, 0.0
        whole = nn.Sequential(linear, nn.ReLU(), norm)
        weight = linear.weight.detach().clone()
        x = th.randn(size, FEATURES)
        program = Program()
        (result,) = program.training_network(parts(whole), program.input("x", FEATURES))
        loss = (result * program.parameter(nn.Parameter(th.tensor([0.0, 1.0, 0.0])))).sum_features()
        program.log("away", (loss - program.parameter(norm.bias)[1:2]).square().mean())
        program.minimise(loss.square().mean(), th.optim.SGD(whole.parameters(), lr=1.0))
        machine = Machine(program, Controller([], 0, False), size)
        machine.prepare()
        machine.load({"x": x})
        machine.run()
        assert machine.number("away") == 0.0
        assert float(norm.ra_var[1]) == 0.0
        assert float(norm.ra_mean[1]) == pytest.approx(0.1)
        if warm:
            assert th.equal(linear.weight[1], weight[1])
            assert float(linear.bias[1].detach()) == float(np.float32(0.1))


@pytest.mark.parametrize("threads", [1, 2])
def test_a_loss_may_use_a_layer_twice(threads):
    before = th.get_num_threads()
    th.set_num_threads(threads)
    try:
        net = nn.Sequential(nn.Linear(FEATURES, 8), nn.Tanh(), nn.Linear(8, FEATURES))
        twin = copy.deepcopy(net).double()
        program = Program()
        x = program.input("x", FEATURES)
        loss = program.network(parts(net), program.network(parts(net), x)).square().mean()
        program.minimise(loss, th.optim.SGD(net.parameters(), lr=1.0))
        machine = Machine(program, Controller([], 0, False), 300)
        numbers = th.randn(300, FEATURES)
        machine.prepare()
        machine.load({"x": numbers})
        machine.run()
    finally:
        th.set_num_threads(before)
    twin(twin(numbers.double())).square().mean().backward()
    for ours, theirs in zip(net.parameters(), twin.parameters(), strict=True):
        np.testing.assert_allclose(
            ours.detach(), (theirs - theirs.grad).detach(), rtol=1e-4, atol=1e-6
        )


def test_what_does_not_fit_is_named():
    program = Program()
    with pytest.raises(NotCovered, match="a BatchRenorm of 4 features gets 3"):
        program.network(parts(SoundBatchRenorm1d(4)), program.input("x", FEATURES))


@pytest.mark.parametrize("count", [0, 3])
def test_only_one_batch_or_two_at_once(count):
    program = Program()
    batches = [program.input(f"x{i}", FEATURES) for i in range(count)]
    with pytest.raises(ValueError, match=f"takes one batch or two, not {count}"):
        program.training_network(parts(network(warm=True)), *batches)


@pytest.mark.parametrize("trains", [False, True])
def test_a_norm_is_not_used_again_before_its_statistics_move(trains):
    program, layers = Program(), parts(network(warm=True))
    x = program.input("x", FEATURES)
    program.training_network(layers, x)
    with pytest.raises(NotCovered, match="used again before its statistics move"):
        (program.training_network if trains else program.network)(layers, x)


def test_statistics_that_would_never_move_are_refused():
    program = Program()
    program.training_network(parts(network(warm=True)), program.input("x", FEATURES))
    with pytest.raises(ValueError, match="no minimise after it"):
        Machine(program, Controller([], 0, False), 4)


@pytest.mark.parametrize("begin", [SoundBatchRenorm1d, nn.LayerNorm, None], ids=str)
def test_readers_of_a_concatenation_may_need_different_parts_of_its_gradient(begin):
    th.manual_seed(0)
    before = nn.Linear(FEATURES, 2)
    linear = nn.Linear(FEATURES + 2, 1)
    other = nn.Sequential(*([] if begin is None else [begin(FEATURES + 2)]), nn.Linear(5, 1))
    whole = nn.ModuleList([before, linear, other]).train(False)
    twin = copy.deepcopy(whole).double()
    program = Program()
    x = program.input("x", FEATURES)
    both = program.joined([x, program.network(parts(before), x)])
    results = [program.network(parts(net), both) for net in (linear, other)]
    total = results[0] * results[1] + both.sum_features()  # of 5, 2 and 1 features
    program.minimise(total.square().mean(), th.optim.SGD(before.parameters(), lr=1.0))
    machine = Machine(program, Controller([], 0, False), 70)
    numbers = th.randn(70, FEATURES)
    machine.prepare()
    machine.load({"x": numbers})
    machine.run()
    x = numbers.double()
    both = th.cat([x, twin[0](x)], dim=1)
    (twin[1](both) * twin[2](both) + both.sum(1, keepdim=True)).square().mean().backward()
    for ours, theirs in zip(before.parameters(), twin[0].parameters(), strict=True):
        np.testing.assert_allclose(
            ours.detach(), (theirs - theirs.grad).detach(), rtol=1e-4, atol=1e-5
        )
