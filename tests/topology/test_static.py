"""The mask that never moves."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_sparse.topology import Exchange, method_named


@pytest.mark.parametrize("progress", [0.0, 0.4, 0.8, 1.0])
@pytest.mark.parametrize("drop_fraction", [0.0, 0.5, 1.0])
def test_nothing_is_ever_exchanged(three_by_four, make_update, progress, drop_fraction):
    update = make_update(progress=progress, drop_fraction=drop_fraction)
    exchange = method_named("static").exchange(three_by_four, update, dense_grad=np.ones(12))
    assert exchange.dropped.size == 0
    assert exchange.grown.size == 0
    assert not exchange


def test_even_a_layer_denser_than_it_shall_end_stays(make_layer, make_update):
    layer = make_layer(np.ones((3, 4)), final_nnz=2)
    assert not method_named("static").exchange(layer, make_update(progress=1.0), dense_grad=None)


def test_it_takes_no_options():
    assert method_named("static").options == frozenset()


@pytest.mark.parametrize(
    ("dropped", "grown", "truth"),
    [([], [], False), ([1], [], True), ([], [2], True), ([0], [3], True)],
)
def test_an_exchange_is_true_if_anything_moves(dropped, grown, truth):
    exchange = Exchange(np.array(dropped, np.int64), np.array(grown, np.int64))
    assert bool(exchange) is truth
