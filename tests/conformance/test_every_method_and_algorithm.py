"""Every registered method on every supported algorithm."""

from __future__ import annotations

import numpy as np
import pytest
from support import ALGORITHMS, assert_masked, make

from sb3_sparse import SparsityCallback
from sb3_sparse.sparsity.distributions import active_counts
from sb3_sparse.topology import method_named, method_names

STEPS = 64
METHODS = method_names()


def callback_for(method: str) -> SparsityCallback:
    options = dict(update_interval=5) if "update_interval" in method_named(method).options else {}
    return SparsityCallback(method, **options)


def start_of(method: str) -> dict[str, float]:
    return {"initial_sparsity": method_named(method).initial_sparsity(0.9)}


def test_a_method_of_a_third_party_is_among_those_tested():
    assert "least-index" in METHODS


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_training_keeps_counts_and_zeros(name, method):
    model = make(name, policy_kwargs=start_of(method))
    before = {layer.name: layer.mask() for layer in model.policy.sparse.layers}
    model.learn(STEPS, callback=callback_for(method))

    assert_masked(model)
    for network in model.policy.sparse.networks:
        assert network.clock > 0
        expected = active_counts([layer.shape for layer in network.layers], 0.9)
        assert [layer.nnz for layer in network.layers] == expected
        # The requested sparsity in whole connections: floor(0.9 N) zeros in every layer.
        requested = sum(layer.size - 9 * layer.size // 10 for layer in network.layers)
        assert abs(network.nnz - requested) <= len(network.layers)
    moved = any((layer.mask() != before[layer.name]).any() for layer in model.policy.sparse.layers)
    assert moved == (method != "static")


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_without_a_callback_the_mask_never_moves_and_active_weights_do(name):
    model = make(name)
    layers = list(model.policy.sparse.layers)
    masks = [layer.mask() for layer in layers]
    weights = [layer.dense().copy() for layer in layers]
    model.learn(STEPS)
    assert_masked(model)
    for layer, mask, weight in zip(layers, masks, weights, strict=True):
        np.testing.assert_array_equal(layer.mask(), mask)
        assert (layer.dense() != weight).any(), layer.name


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_no_drop_is_exactly_static(name):
    static = make(name)
    static.learn(STEPS, callback=SparsityCallback("static"))
    still = make(name)
    still.learn(STEPS, callback=SparsityCallback("rigl", update_interval=5, drop_fraction=0.0))
    for a, b in zip(static.policy.parameters(), still.policy.parameters(), strict=True):
        assert (a == b).all()
