from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sb3_sparse.engine.structure import Structure
from sb3_sparse.errors import CorruptStateError

masks = st.tuples(st.integers(1, 9), st.integers(1, 9)).flatmap(lambda s: arrays(bool, s))


def test_indices_by_rows_and_by_columns_of_a_small_mask():
    #  . 1 .
    #  1 . 1
    structure = Structure.of_mask(np.array([[0, 1, 0], [1, 0, 1]]), (2, 3))
    assert structure.row_start.tolist() == [0, 1, 3]
    assert structure.column.tolist() == [1, 0, 2]
    assert structure.column_start.tolist() == [0, 1, 2, 3]
    assert structure.row.tolist() == [1, 0, 1]
    assert structure.position.tolist() == [1, 0, 2]
    assert structure.nnz == 3
    assert structure.nbytes == 4 * (3 + 3 + 4 + 3 + 3)


@given(masks)
def test_a_mask_comes_back(mask):
    structure = Structure.of_mask(mask, mask.shape)
    np.testing.assert_array_equal(structure.mask().reshape(mask.shape), mask)
    assert structure.flat.tolist() == [i for i, on in enumerate(mask.ravel()) if on]


@given(masks)
def test_the_transpose_is_that_of_the_transposed_mask(mask):
    structure, turned = Structure.of_mask(mask, mask.shape), Structure.of_mask(mask.T, mask.T.shape)
    np.testing.assert_array_equal(structure.column_start, turned.row_start)
    np.testing.assert_array_equal(structure.row, turned.column)
    values = np.arange(structure.nnz)
    np.testing.assert_array_equal(
        values[structure.position], [values[k] for k in np.argsort(structure.column, kind="stable")]
    )


@given(masks, st.randoms())
def test_places_in_another_structure(mask, random):
    other = mask.copy().ravel()
    for i in range(other.size):
        if random.random() < 0.5:
            other[i] = not other[i]
    mine, theirs = Structure.of_mask(mask, mask.shape), Structure.of_mask(other, mask.shape)
    lookup = {flat: place for place, flat in enumerate(theirs.flat.tolist())}
    assert mine.places_in(theirs).tolist() == [lookup.get(flat, -1) for flat in mine.flat.tolist()]


@pytest.mark.parametrize(
    "flat",
    [[-1, 2], [0, 6], [1, 1], [3, 2], [[0], [1]]],
    ids=["low", "high", "twice", "order", "2d"],
)
def test_bad_indices_are_rejected(flat):
    with pytest.raises(CorruptStateError, match="2x3 layer must ascend strictly within 0 to 5"):
        Structure(np.array(flat), (2, 3))


def test_copies_share_the_indices_and_pickles_keep_them():
    structure = Structure(np.array([1, 4]), (2, 3))
    assert copy.deepcopy(structure) is structure
    addresses = structure.addresses
    twin = pickle.loads(pickle.dumps(structure))
    assert twin.flat.tolist() == [1, 4]
    assert twin.addresses != addresses
