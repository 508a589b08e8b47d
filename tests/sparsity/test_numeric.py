from __future__ import annotations

import numpy as np
import pytest
from support import make

from sb3_sparse import SparsityCallback
from sb3_sparse.sparsity.distributions import active_counts, check_sparsity
from sb3_sparse.sparsity.numeric import as_float, is_number, is_whole


@pytest.mark.parametrize("kind", [int, np.int8, np.int64, np.uint32])
def test_whole_numbers_of_python_and_numpy_are_whole_numbers_and_numbers(kind):
    assert is_whole(kind(3))
    assert is_number(kind(3))


@pytest.mark.parametrize("kind", [float, np.float16, np.float32, np.float64])
def test_floats_of_python_and_numpy_are_numbers_but_not_whole(kind):
    assert is_number(kind(3))
    assert not is_whole(kind(3))


@pytest.mark.parametrize("value", [True, np.bool_(True), "3", None, [3], 3j])
def test_nothing_else_is(value):
    assert not is_whole(value)
    assert not is_number(value)


def test_a_float_of_fewer_digits_means_what_it_shows():
    assert as_float(np.float32(0.9)) == 0.9
    assert float(np.float32(0.9)) != 0.9
    # 100 connections at 90 % are 10, not 11.
    assert active_counts([(10, 10)], np.float32(0.9), "uniform") == [10]
    assert check_sparsity(np.float32(0.95)) == 0.95


def test_arguments_take_numpys_numbers():
    model = make(
        "SAC",
        policy_kwargs=dict(
            sparsity={"actor": np.float32(0.9), "critic": np.float64(0.8)},
            mask_seed=np.int64(7),
            weight_decay=np.float32(1e-4),
            sparsity_aware_init=np.bool_(True),
        ),
    )
    plain = make(
        "SAC",
        policy_kwargs=dict(sparsity={"actor": 0.9, "critic": 0.8}, mask_seed=7, weight_decay=1e-4),
    )
    for one, other in zip(model.policy.sparse.layers, plain.policy.sparse.layers, strict=True):
        np.testing.assert_array_equal(one.mask(), other.mask())
    callback = SparsityCallback(
        "rigl",
        update_interval=np.int64(5),
        drop_fraction=np.float32(0.5),
        begin=np.float64(0.0),
        end=np.float32(0.8),
    )
    model.learn(50, callback=callback)
    assert model.policy.sparse.networks[0].mask_updates
