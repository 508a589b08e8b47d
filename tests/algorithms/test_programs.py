"""Programs by themselves: values and gradients against torch, and the order of operations."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch as th
from algorithms_support import make
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from sb3_contrib.common.utils import quantile_huber_loss
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike

import sb3_sparse
from sb3_sparse.engine.controller import Controller
from sb3_sparse.fused.machine import Machine
from sb3_sparse.fused.operations import Operation, in_phases
from sb3_sparse.fused.parts import parts
from sb3_sparse.fused.program import Program
from sb3_sparse.fused.quantiles import argmax, quantile_huber, sort, sum_blocks
from sb3_sparse.fused.values import Value

FEATURES = 3


class Room:
    """A program on one vector of parameters and no network, with as many inputs."""

    def __init__(self, build, batch, optimizer=th.optim.Adam, start=None, **kwargs):
        start = th.zeros(FEATURES) if start is None else start
        self.vector = th.nn.Parameter(start.clone())
        self.optimizer = optimizer([self.vector], **kwargs)
        program = Program()
        x = program.input("x", len(start))
        loss = build(program, x, program.parameter(self.vector))
        program.log("loss", loss)
        program.minimise(loss, self.optimizer)
        self.machine = Machine(program, Controller([], 0, False), batch)

    def step(self, x):
        self.machine.prepare()
        self.machine.load({"x": x})
        self.machine.run()
        return self.machine.number("loss")


def gradient_of(build, x, start):
    """By a step of size 1 of plain descent, which torch takes with the program's gradient."""
    room = Room(build, len(x), th.optim.SGD, start, lr=1.0)
    loss = room.step(x)
    return loss, start - room.vector.detach()


UNARY = {
    "exp": (lambda v: (v * 0.5).exp(), lambda t: (t * 0.5).exp()),
    "log": (lambda v: (v.square() + 0.5).log(), lambda t: (t.square() + 0.5).log()),
    "sqrt": (lambda v: (v.square() + 0.5).sqrt(), lambda t: (t.square() + 0.5).sqrt()),
    "tanh": (Value.tanh, th.tanh),
    "sigmoid": (Value.sigmoid, th.sigmoid),
    "softplus": (Value.softplus, th.nn.functional.softplus),
    "huber": (Value.huber, lambda t: th.nn.functional.smooth_l1_loss(
        t, th.zeros_like(t), reduction="none")),
    "square": (Value.square, th.square),
    "clamp": (lambda v: v.clamp(-0.7, 0.9), lambda t: t.clamp(-0.7, 0.9)),
    "negative": (lambda v: -v, lambda t: -t),
    "part": (lambda v: v[0:1] + v[1:3], lambda t: t[..., 0:1] + t[..., 1:3]),
    "over one": (lambda v: 1.0 - v * 2.0, lambda t: 1.0 - t * 2.0),
    "layer norm": (lambda v: v.layer_norm(0.1), lambda t: th.nn.functional.layer_norm(
        t, t.shape[-1:], eps=0.1)),
}  # fmt: skip
BINARY = {
    "add": (lambda a, b: a + b, lambda a, b: a + b),
    "subtract": (lambda a, b: a - b, lambda a, b: a - b),
    "multiply": (lambda a, b: a * b, lambda a, b: a * b),
    "divide": (lambda a, b: a / (b.square() + 1.0), lambda a, b: a / (b.square() + 1.0)),
    "least": (lambda a, b: a.least(b), th.minimum),
    "sum": (lambda a, b: a.sum_features() * b, lambda a, b: a.sum(-1, keepdim=True) * b),
}
STEPS = st.lists(
    st.sampled_from([name for name in (*UNARY, *BINARY) if name != "part"]), min_size=1, max_size=6
)


def expression(steps, table):
    def build(x, vector):
        value = x * vector
        for name in steps:
            one = UNARY.get(name) or BINARY[name]
            value = one[table](value, vector) if name in BINARY else one[table](value)
        return value.mean()

    return build


@settings(max_examples=40, deadline=None)
@given(STEPS, st.sampled_from([1, 5, 63, 64, 65, 200]), st.integers(0, 1000))
def test_gradients_of_expressions_equal_those_of_autograd(steps, batch, seed):
    random = th.Generator().manual_seed(seed)
    x = th.randn(batch, FEATURES, generator=random)
    start = th.randn(FEATURES, generator=random)
    ours, grad = gradient_of(lambda _, a, b: expression(steps, 0)(a, b), x, start)
    single, vector = start.clone().requires_grad_(), start.double().requires_grad_()
    rounded = expression(steps, 1)(x, single)
    rounded.backward()
    # Else float32 overflows on the way.
    assume(np.isfinite(rounded.item()) and bool(single.grad.isfinite().all()))
    loss = expression(steps, 1)(x.double(), vector)
    loss.backward()
    scale = max(1.0, float(vector.grad.abs().max()))
    assume(np.isfinite(scale) and scale < 1e4 and abs(loss.item()) < 1e4)
    assert ours == pytest.approx(loss.item(), rel=1e-4, abs=1e-4)
    np.testing.assert_allclose(grad, vector.grad, rtol=1e-3, atol=2e-4 * scale)


def test_a_part_of_the_features():
    x, start = th.randn(70, FEATURES), th.randn(FEATURES)
    ours, grad = gradient_of(lambda _, a, b: UNARY["part"][0](a * b).mean(), x, start)
    vector = start.clone().requires_grad_()
    loss = UNARY["part"][1](x * vector).mean()
    loss.backward()
    assert ours == pytest.approx(float(loss), abs=1e-6)
    np.testing.assert_allclose(grad, vector.grad, atol=1e-6)


NUMBERS = st.floats(width=32, allow_nan=True, allow_infinity=True)


@settings(max_examples=60, deadline=None)
@given(st.lists(NUMBERS, min_size=1, max_size=70))
def test_features_are_sorted_as_by_torch(numbers):
    x = th.tensor([numbers], dtype=th.float32)
    start = th.zeros(len(numbers))
    _, grad = gradient_of(lambda _, a, b: (sort(a) * b).sum().sum_features(), x, start)
    assert np.array_equal(grad, x.sort().values[0], equal_nan=True)


@pytest.mark.parametrize("batch", [1, 63, 64, 65, 200])
@pytest.mark.parametrize("features", [1, 2, 7, 8, 50])
def test_each_entry_is_sorted_by_itself(features, batch, instructions):
    x = th.randn(batch, features, generator=th.Generator().manual_seed(features))
    start = th.zeros(features)
    _, grad = gradient_of(lambda _, a, b: (sort(a) * b).sum().sum_features(), x, start)
    np.testing.assert_allclose(grad, x.sort().values.sum(0), rtol=1e-5, atol=1e-5)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from([-1.0, 0.0, 2.0, float("inf"), float("nan")]), min_size=1))
def test_the_largest_feature_is_the_first_of_equal_ones(numbers):
    room = Room(
        lambda _, a, b: (argmax(a) + b[0:1] * 0.0).sum(), 1, th.optim.SGD,
        th.zeros(len(numbers)), lr=0.0,
    )  # fmt: skip
    assert room.step(th.tensor([numbers])) == np.argmax(numbers)  # NaN is the largest


@pytest.mark.parametrize("batch", [1, 65])
@pytest.mark.parametrize(("blocks", "size"), [(1, 4), (4, 1), (3, 5)])
def test_one_feature_of_each_block(blocks, size, batch, instructions):
    random = th.Generator().manual_seed(blocks)
    x = th.randn(batch, blocks * size, generator=random)
    start = th.randn(blocks * size, generator=random)

    def build(program, a, b):
        return (a * b).pick(argmax(sum_blocks(a, size)), size).square().mean()

    ours, grad = gradient_of(build, x, start)
    vector = start.clone().requires_grad_()
    best = x.view(batch, blocks, size).sum(1).argmax(1)
    picked = (x * vector).view(batch, blocks, size)[th.arange(batch), :, best]
    loss = picked.square().mean()
    loss.backward()
    assert ours == pytest.approx(float(loss.detach()), rel=1e-5)
    np.testing.assert_allclose(grad, vector.grad, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("size", [0, 3, 14])
def test_features_that_are_no_blocks(size):
    x = Program().input("x", 7)
    for divide in (partial(sum_blocks, x), partial(x.pick, x[0:1])):
        with pytest.raises(ValueError, match=f"7 features cannot be divided into blocks of {size}"):
            divide(size)


@pytest.mark.parametrize("batch", [1, 65, 200])
@pytest.mark.parametrize(("estimates", "targets"), [(1, 1), (1, 6), (6, 1), (7, 46)])
def test_the_loss_of_quantiles_is_that_of_sb3_contrib(estimates, targets, batch, instructions):
    random = th.Generator().manual_seed(targets)
    size = max(estimates, targets)
    x, start = (3 * th.randn(*shape, generator=random) for shape in ((batch, size), (size,)))

    def build(program, a, b):
        loss = quantile_huber((a + b)[0:estimates], a[0:targets])
        return loss.sum_features().mean() * (1 / targets)

    ours, grad = gradient_of(build, x, start)
    vector = start.double().requires_grad_()
    current = (x.double() + vector)[:, :estimates]
    loss = quantile_huber_loss(current, x[:, :targets].double(), sum_over_quantiles=True)
    loss.backward()
    assert ours == pytest.approx(float(loss.detach()), rel=1e-5)
    np.testing.assert_allclose(grad, vector.grad, rtol=1e-4, atol=1e-6)


def results_of(function, numbers):
    """A function of each number, by a program that adds up one at a time."""
    found = []

    def build(program, x, vector):
        return (function(x[0:1]) + vector[0:1] * 0.0).sum()

    room = Room(build, 1, th.optim.SGD, lr=0.0)
    for number in numbers:
        found.append(room.step(th.full((1, FEATURES), float(number))))
    return np.array(found, dtype=np.float32)


EDGES = {
    "exp": (Value.exp, th.exp, [-104.0, -100.0, -88.0, -1e-7, 0.0, 1e-7, 1.0, 87.9, 89.0]),
    "log": (Value.log, th.log, [1e-37, 1e-6, 0.5, 0.999999, 1.0, 1.000001, 2.0, 3e38, 0.0, -1.0]),
    "tanh": (Value.tanh, th.tanh, [-100.0, -9.0, -1.0, -1e-4, 0.0, 1e-8, 1e-4, 0.5, 8.0, 50.0]),
    "softplus": (Value.softplus, th.nn.functional.softplus, [-90.0, -20.0, 0.0, 19.9, 20.1, 90.0]),
}


@pytest.mark.parametrize("name", EDGES)
def test_functions_near_their_edges(name, instructions):
    function, reference, numbers = EDGES[name]
    numbers = [*numbers, float("inf"), float("nan"), *(-float("inf"),) * (name != "log")]
    wanted = reference(th.tensor(numbers).double()).float().numpy()
    np.testing.assert_allclose(results_of(function, numbers), wanted, rtol=3e-6, atol=1e-37)


@pytest.mark.parametrize("batch", [1, 63, 64, 65, 200])
@pytest.mark.parametrize(
    "kind", [th.float32, th.float64, th.float16, th.int64, th.int32, th.int16, th.int8, th.uint8,
             th.bool])  # fmt: skip
def test_rows_of_every_type(kind, batch):
    x = (th.arange(batch * FEATURES).view(batch, FEATURES) % 7).to(kind)
    room = Room(lambda _, a, b: (a + b).sum().sum_features(), 200, th.optim.SGD, lr=0.0)
    assert room.step(x) == float(x.double().sum())


@pytest.mark.parametrize(
    ("kind", "kwargs"),
    [
        (th.optim.Adam, dict(lr=0.1)),
        (th.optim.Adam, dict(lr=0.1, weight_decay=0.1, betas=(0.5, 0.8), eps=1e-3)),
        (th.optim.AdamW, dict(lr=0.1, weight_decay=0.3)),
        (RMSpropTFLike, dict(lr=0.1, alpha=0.9, eps=1e-3, weight_decay=0.1)),
    ],
)
def test_steps_of_optimizers(kind, kwargs):
    start = th.tensor([1.0, -2.0, 0.5])
    room = Room(lambda _, a, b: (a * b).square().mean(), 70, kind, start, **kwargs)
    vector = th.nn.Parameter(start.clone())
    optimizer = kind([vector], **kwargs)
    for step in range(10):
        x = th.randn(70, FEATURES, generator=th.Generator().manual_seed(step))
        room.step(x)
        optimizer.zero_grad()
        (x * vector).square().mean().backward()
        optimizer.step()
        th.testing.assert_close(room.vector.detach(), vector.detach(), rtol=1e-5, atol=1e-6)
    one, two = room.optimizer.state[room.vector], optimizer.state[vector]
    assert float(one["step"]) == float(two["step"]) == 10
    for name in two.keys() - {"step"}:
        th.testing.assert_close(one[name], two[name], rtol=1e-4, atol=1e-7)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.integers(0, 99), st.integers(0, 99)),
                max_size=25))  # fmt: skip
def test_phases_keep_what_depends_on_each_other_in_order(recorded):
    program = Program()
    values = [Value(program, 1, True)]
    operations = []
    for tiled, changes, first, second in recorded:
        values.append(Value(program, 1, tiled))
        operands = (values[first % (len(values) - 1)], values[second % (len(values) - 1)])
        to, changes = values[-1], changes and not tiled
        operations.append(Operation("ADD", to, operands, tiled=tiled, changes=changes))
    ordered = in_phases(operations)
    assert sorted(map(id, ordered)) == sorted(map(id, operations))
    place = {id(operation): number for number, operation in enumerate(ordered)}
    for number, operation in enumerate(operations):
        for other in operations[:number]:
            reads = any(operand is other.to for operand in operation.operands)
            if reads or other.changes or operation.changes:
                assert place[id(other)] < place[id(operation)]


@pytest.mark.parametrize("compute", ["masked", "sparse"])
def test_a_network_that_two_losses_pass_through_while_an_optimizer_begins(compute):
    """Torch takes the first step, which makes moments; the second loss needs the network still."""
    policy = make(sb3_sparse, "DQN", policy_kwargs=dict(compute=compute)).policy
    net = policy.q_net.q_net
    size = net[0].in_features
    x = th.randn(70, size)
    moved = {}
    for way in ("torch", "fused"):
        vectors = [th.nn.Parameter(th.ones(size)) for _ in range(2)]
        optimizers = [th.optim.Adam([vector], lr=0.1) for vector in vectors]
        if way == "torch":
            for vector, optimizer in zip(vectors, optimizers, strict=True):
                net(x * vector).square().mean().backward()
                optimizer.step()
        else:
            program = Program()
            inputs = program.input("x", size)
            for vector, optimizer in zip(vectors, optimizers, strict=True):
                result = program.network(parts(net), inputs * program.parameter(vector))
                program.minimise(result.square().mean(), optimizer)
            machine = Machine(program, policy.sparse, len(x))
            machine.prepare()
            machine.load({"x": x})
            machine.run()
        moved[way] = vectors
    assert all((vector != 1).all() for vector in moved["torch"])
    th.testing.assert_close(moved["fused"], moved["torch"])
