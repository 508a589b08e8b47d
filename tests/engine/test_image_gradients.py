"""Dense gradients of sparse convolutions in chains, which RigL grows by."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest
import torch as th
from image_support import chains, close, convolution, convolutions, impala, twins
from support import make
from torch import nn

from sb3_sparse import SparsityCallback
from sb3_sparse.engine.images import ImagePass
from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.engine.residual import Residual
from sb3_sparse.engine.sequential import chain_up
from sb3_sparse.engine.sparse import SparseStorage


class Watched:
    """Modules with dense masked convolutions, and a copy whose storages keep dense gradients.

    :param capturing: tells whether they are wanted
    """

    def __init__(
        self,
        *modules: nn.Module,
        functional: bool = False,
        capturing: Callable[[], bool] = lambda: True,
    ) -> None:
        self.dense, _ = twins(*modules)
        self.sparse = copy.deepcopy(self.dense)
        self.storages = []
        for number, layer in enumerate(convolutions(self.sparse)):
            masked = MaskedStorage(str(number), layer)
            masked.set_mask(layer.mask.numpy())
            self.storages.append(SparseStorage(masked))
        for storage in self.storages:
            storage.hook_gradient(functional, capturing)
        chain_up(self.sparse)
        self.weights = [layer.weight for layer in convolutions(self.dense)]

    def taken(self) -> list[th.Tensor]:
        return [storage.gradient_mask.take()() for storage in self.storages]

    def equal(self, found: list[th.Tensor], expected: list[th.Tensor]) -> None:
        for ours, theirs in zip(found, expected, strict=True):
            close(ours, theirs)
        inactive = (
            grad.reshape(-1)[~storage.mask()]
            for grad, storage in zip(found, self.storages, strict=True)
        )
        assert any(grad.any() for grad in inactive)


# Modules, shape of an image, and the steps of each chain.
NETWORKS = {
    "impala": (impala, (2, 7, 9), [7]),
    "nature": (
        lambda: [
            nn.Conv2d(1, 3, 8, 4),
            nn.ReLU(),
            nn.Conv2d(3, 4, 4, 2),
            nn.ReLU(),
            nn.Conv2d(4, 4, 3),
        ],
        (1, 37, 38),
        [3],
    ),
    "others": (
        lambda: [
            nn.MaxPool2d((1, 2)),
            nn.Conv2d(2, 3, (2, 3), (1, 2), (1, 2)),
            nn.Tanh(),
            Residual(convolution(3, 2), nn.ReLU(), Residual(nn.ReLU(), convolution()), nn.ReLU(),
                     nn.Conv2d(2, 3, 1)),
            nn.GELU(),
            nn.Conv2d(3, 1, (5, 1), padding=(2, 0)),
        ],
        (2, 5, 8),
        [4, 1],
    ),
}  # fmt: skip


@pytest.mark.parametrize("batch", [1, 16, 33])
@pytest.mark.parametrize("name", NETWORKS)
def test_a_backward_pass_gives_the_gradient_of_the_dense_layer(ways, name, batch):
    modules, shape, expected = NETWORKS[name]
    both = Watched(*modules())
    x = th.randn(batch, *shape)
    for network in (both.sparse, both.dense):
        network(x).square().sum().backward()
    assert chains(both.sparse) == expected
    both.equal(both.taken(), [weight.grad for weight in both.weights])


def test_passes_add_up_until_the_step_and_start_anew_behind_it(ways):
    both = Watched(*impala())
    inputs = th.randn(3, 17, 2, 7, 9)
    for network in (both.sparse, both.dense):
        # Two passes of one backward call: the gradient that the optimizer applies has both.
        (network(inputs[0]).square().sum() + network(inputs[1]).pow(3).sum()).backward()
    both.equal(both.taken(), [weight.grad for weight in both.weights])
    for network in (both.sparse, both.dense):
        network.zero_grad()
        network(inputs[2]).square().sum().backward()
    both.equal(both.taken(), [weight.grad for weight in both.weights])


def test_later_passes_leave_a_dense_gradient_alone(ways):
    both = Watched(*impala())
    x = th.randn(17, 2, 7, 9)
    for network in (both.sparse, both.dense):
        network(x).square().sum().backward()
    later = [storage.gradient_mask.take() for storage in both.storages]
    for _ in range(3):  # they would write the memory of the first pass if it were free
        both.sparse(-2 * x).square().sum().backward()
        with th.no_grad():
            both.sparse(3 * x)
    both.equal([compute() for compute in later], [weight.grad for weight in both.weights])


def test_of_functional_gradients_the_first_without_a_graph_counts(ways):
    both = Watched(*impala(), functional=True)
    x = th.randn(17, 2, 7, 9)
    weights = [layer.weight for layer in convolutions(both.sparse)]
    for power, graph in ((2, True), (3, False), (4, False)):
        th.autograd.grad(both.sparse(x).pow(power).sum(), weights, create_graph=graph)
    expected = th.autograd.grad(both.dense(x).pow(3).sum(), both.weights)
    both.equal(both.taken(), list(expected))


def test_images_that_are_too_large_for_the_kernels_give_dense_gradients(monkeypatch):
    monkeypatch.setattr("sb3_sparse.engine.image_layout.LIMIT", 100)
    monkeypatch.setattr(ImagePass, "forward", None)  # which is not called
    both = Watched(*impala())
    x = th.randn(17, 2, 7, 9)
    for network in (both.sparse, both.dense):
        network(x).square().sum().backward()
    both.equal(both.taken(), [weight.grad for weight in both.weights])


def test_what_nobody_wants_is_not_computed(monkeypatch):
    computed = []
    outer = ImagePass._outer
    monkeypatch.setattr(ImagePass, "_outer", lambda *args: computed.append(0) or outer(*args))
    wanted = [False]
    both = Watched(*impala(), capturing=lambda: wanted[0])
    x = th.randn(5, 2, 7, 9)
    both.sparse(x).sum().backward()
    assert all(storage.gradient_mask.take() is None for storage in both.storages)
    wanted[0] = True
    both.sparse(x).sum().backward()
    later = [storage.gradient_mask.take() for storage in both.storages]
    assert computed == []  # only who takes it computes it
    later[0]()
    assert computed == [0]


def test_a_layer_alone_and_one_that_is_hooked_give_theirs_too(ways):
    both = Watched(*impala())
    for network in (both.sparse, both.dense):
        network[0].register_forward_hook(lambda *_: None)
        network(th.ones(5, 2, 7, 9)).square().sum().backward()
    both.equal(both.taken(), [weight.grad for weight in both.weights])


@pytest.mark.parametrize("method", ["rigl", "static"])
@pytest.mark.parametrize("name", ["DQN", "PPO"])
def test_training_computes_dense_gradients_for_updates_only(name, method, monkeypatch):
    computed = []
    outer = ImagePass._outer
    monkeypatch.setattr(ImagePass, "_outer", lambda *args: computed.append(0) or outer(*args))
    options = {} if method == "static" else {"update_interval": 6}
    kwargs = dict(compute="sparse", features_extractor_kwargs=dict(features_dim=16), net_arch=[])
    model = make(name, "TinyImages-v0", policy_kwargs=kwargs)
    model.learn(100, callback=SparsityCallback(method, **options))
    layers = [layer for layer in model.policy.sparse.layers if isinstance(layer.module, nn.Conv2d)]
    assert len(layers) == 3
    updates = max(network.mask_updates for network in model.policy.sparse.networks)
    moving = sum(layer.nnz < layer.size for layer in layers)
    assert (updates > 0) == (method == "rigl")
    assert moving * updates <= len(computed) <= len(layers) * (updates + 1) * (method == "rigl")
