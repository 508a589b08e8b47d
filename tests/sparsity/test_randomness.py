"""Random numbers by address."""

from __future__ import annotations

import hashlib
import random
from fractions import Fraction

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_sparse.sparsity.randomness import random_bits, random_uniform

quick = settings(max_examples=100, deadline=None)
seeds = st.integers(0, 2**40)
addresses = st.text(max_size=20)
numbers = st.integers(0, 2**31)

# From SeedSequence and PCG64 (XSL-RR 128/64) written out in plain Python.
PINNED = [
    9909375855947962242,
    16293718249132703410,
    8224660940900868069,
    1532674412084144542,
]


def test_bits_of_one_address_are_pinned():
    assert random_bits(7, "actor.mu/mask", 4, number=3).tolist() == PINNED


def test_number_zero_is_the_default():
    bits = random_bits(7, "actor.mu/mask", 4).tolist()
    assert bits == random_bits(7, "actor.mu/mask", 4, number=0).tolist()
    assert bits != PINNED


@quick
@given(seed=seeds, address=addresses, number=numbers)
def test_the_recipe_is_pcg64_seeded_by_seed_number_and_digest(seed, address, number):
    digest = hashlib.sha256(address.encode("utf-8")).digest()[:16]
    words = np.frombuffer(digest, "<u4").tolist()
    entropy = np.random.SeedSequence([seed, number, *words])
    expected = np.random.Generator(np.random.PCG64(entropy)).bit_generator.random_raw(5)
    assert random_bits(seed, address, 5, number).tolist() == expected.tolist()


@quick
@given(seed=seeds, address=addresses, number=numbers, count=st.integers(1, 50))
def test_same_address_same_bits(seed, address, number, count):
    first = random_bits(seed, address, count, number)
    random_bits(seed + 1, address, count, number)
    assert first.dtype == np.uint64
    assert first.shape == (count,)
    assert first.tolist() == random_bits(seed, address, count, number).tolist()


@quick
@given(places=st.lists(st.tuples(seeds, addresses, numbers), min_size=2, max_size=8, unique=True))
def test_different_addresses_different_bits(places):
    drawn = {tuple(random_bits(seed, address, 2, n).tolist()) for seed, address, n in places}
    assert len(drawn) == len(places)


def test_seed_and_number_are_not_confused():
    places = [(s, n) for s in (0, 1, 2, 2**32, 2**32 + 1) for n in (0, 1, 2)]
    drawn = {tuple(random_bits(s, "layer", 2, n).tolist()) for s, n in places}
    assert len(drawn) == len(places)


@pytest.mark.parametrize("draw", [random_bits, random_uniform])
def test_global_generators_are_untouched_and_do_not_matter(draw):
    np.random.seed(1)
    th.manual_seed(1)
    random.seed(1)
    numpy_before = np.random.get_state()
    torch_before = th.get_rng_state()
    python_before = random.getstate()
    first = draw(5, "layer", 100)
    numpy_after = np.random.get_state()
    np.testing.assert_array_equal(numpy_before[1], numpy_after[1])
    assert numpy_before[2:] == numpy_after[2:]
    assert th.equal(torch_before, th.get_rng_state())
    assert python_before == random.getstate()
    np.random.seed(2)
    th.manual_seed(2)
    random.seed(2)
    np.testing.assert_array_equal(first, draw(5, "layer", 100))


def test_uniform_numbers_are_the_top_53_bits_on_minus_one_to_one():
    expected = [Fraction(bits // 2**11, 2**52) - 1 for bits in PINNED]
    drawn = random_uniform(7, "actor.mu/mask", 4, number=3).tolist()
    assert [Fraction(value) for value in drawn] == expected


def test_uniform_numbers_fill_their_range_evenly():
    drawn = random_uniform(0, "layer", 20_000)
    assert drawn.min() >= -1
    assert drawn.max() < 1
    in_tenths = np.bincount(((drawn + 1) * 5).astype(int), minlength=10)
    # Binomial with mean 2000 and standard deviation 42: five of them.
    assert np.abs(in_tenths - 2000).max() < 212


def test_every_bit_is_set_half_of_the_time():
    bits = random_bits(0, "layer", 10_000)
    ones = ((bits[:, None] >> np.arange(64, dtype=np.uint64)) & np.uint64(1)).sum(axis=0)
    # Mean 5000, standard deviation 50: five of them.
    assert np.abs(ones.astype(int) - 5000).max() < 250
