"""How actor and critics share a budget, by hand for HalfCheetah SAC."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_sparse.errors import ConfigError
from sb3_sparse.sparsity.budgets import feasible_actor_share, split_sparsity

ACTOR = 17 * 256 + 256 * 256 + 256 * (6 + 6)  # 72960
CRITICS = 2 * (23 * 256 + 256 * 256 + 256 * 1)  # 143360

sizes = st.integers(1, 10**7)
sparsities = st.integers(0, 99).map(lambda k: k / 100)


@pytest.mark.parametrize("sparsity", [0.0, 0.5, 0.9, 0.99])
def test_at_the_share_of_its_size_actor_and_critics_are_equally_sparse(sparsity):
    actor, critic = split_sparsity(ACTOR, CRITICS, sparsity, 72960 / 216320)
    assert actor == pytest.approx(sparsity, abs=1e-12)
    assert critic == pytest.approx(sparsity, abs=1e-12)


def test_half_and_half_at_90_per_cent():
    # 21632 connections remain, 10816 for each side.
    actor, critic = split_sparsity(ACTOR, CRITICS, 0.9, 0.5)
    assert actor == pytest.approx(1 - 10816 / 72960, abs=1e-12)
    assert critic == pytest.approx(1 - 10816 / 143360, abs=1e-12)


def test_both_critics_are_counted():
    # 100 + 2 * 150 = 400 connections, half remain; a quarter of the 200 is 50 for the actor, and
    # 150 for the critics: 75 of 150 in each.
    assert split_sparsity(100, 300, 0.5, 0.25) == pytest.approx((0.5, 0.5), abs=1e-12)
    assert split_sparsity(100, 300, 0.5, 0.1) == pytest.approx((0.8, 0.4), abs=1e-12)


@settings(max_examples=150, deadline=None)
@given(actor_size=sizes, critics_size=sizes, sparsity=sparsities, position=st.floats(0.01, 0.99))
def test_what_remains_meets_the_total_and_the_share(actor_size, critics_size, sparsity, position):
    budget = (1 - sparsity) * (actor_size + critics_size)
    least = max(0.0, 1 - critics_size / budget)
    most = min(1.0, actor_size / budget)
    share = least + position * (most - least)
    actor, critic = split_sparsity(actor_size, critics_size, sparsity, share)
    kept_actor = (1 - actor) * actor_size
    kept_critics = (1 - critic) * critics_size
    assert kept_actor + kept_critics == pytest.approx(budget, rel=1e-6)
    assert kept_actor == pytest.approx(share * budget, rel=1e-6, abs=1e-6 * actor_size)
    assert 0 <= actor < 1
    assert 0 <= critic < 1


# At 0.2, 173056 of 216320 remain. The actor can hold 72960 of them (0.42159), the critics 143360,
# so that 29696 must be the actor's (0.17160). The range is named rounded inwards.
def test_feasible_range_when_both_ends_bind():
    low, high = feasible_actor_share(ACTOR, CRITICS, 0.2)
    assert low == pytest.approx(29696 / 173056, abs=1e-12)
    assert high == pytest.approx(72960 / 173056, abs=1e-12)


def test_feasible_range_when_only_the_actor_can_overflow():
    # 108160 remain, less than the critics hold.
    low, high = feasible_actor_share(ACTOR, CRITICS, 0.5)
    assert low == 0.0
    assert high == pytest.approx(72960 / 108160, abs=1e-12)


def test_every_share_is_feasible_when_each_side_could_hold_all():
    assert feasible_actor_share(ACTOR, CRITICS, 0.9) == (0.0, 1.0)


@pytest.mark.parametrize("share", [0.43, 0.17, 0.9, 0.01, 0, 1, 0.0, 1.0, -0.5, 1.5])
def test_infeasible_share_is_an_error_that_names_the_range(share):
    with pytest.raises(ConfigError, match=r"between 0\.1716 and 0\.4215") as caught:
        split_sparsity(ACTOR, CRITICS, 0.2, share)
    assert f"actor_share={share}" in str(caught.value)


@pytest.mark.parametrize("share", [0.18, 0.3, 0.42])
def test_share_inside_the_named_range_is_accepted(share):
    actor, critic = split_sparsity(ACTOR, CRITICS, 0.2, share)
    assert actor == pytest.approx(1 - share * 173056 / 72960, abs=1e-12)
    assert critic == pytest.approx(1 - (1 - share) * 173056 / 143360, abs=1e-12)


def test_share_at_the_very_edge_leaves_one_side_dense():
    actor, critic = split_sparsity(ACTOR, CRITICS, 0.2, 72960 / 173056)
    assert actor == pytest.approx(0.0, abs=1e-9)
    assert actor >= 0.0
    assert critic == pytest.approx(1 - 100096 / 143360, abs=1e-9)
    actor, critic = split_sparsity(ACTOR, CRITICS, 0.2, 29696 / 173056)
    assert critic == pytest.approx(0.0, abs=1e-9)
    assert critic >= 0.0
    assert actor == pytest.approx(1 - 29696 / 72960, abs=1e-9)


@pytest.mark.parametrize("share", [0, 1])
def test_a_share_that_leaves_one_side_nothing_is_an_error(share):
    with pytest.raises(ConfigError, match=r"between 0\.0001 and 0\.9999"):
        split_sparsity(ACTOR, CRITICS, 0.9, share)


def test_a_share_that_is_nan_is_an_error():
    with pytest.raises(ConfigError, match="actor_share=nan"):
        split_sparsity(ACTOR, CRITICS, 0.9, math.nan)


@pytest.mark.parametrize("share", [True, False, "0.5", None, [0.5]])
def test_a_share_that_is_no_number_is_an_error_that_shows_it(share):
    with pytest.raises(ConfigError, match=r"number in \(0, 1\)") as caught:
        split_sparsity(ACTOR, CRITICS, 0.9, share)
    assert repr(share) in str(caught.value)


@pytest.mark.parametrize("sparsity", [1.0, -0.1, math.nan, True, "0.9"])
def test_total_sparsity_is_checked(sparsity):
    with pytest.raises(ConfigError, match=r"sparsity .*\[0, 1\)"):
        split_sparsity(ACTOR, CRITICS, sparsity, 0.3)
