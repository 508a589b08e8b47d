"""What the guard concludes from returns."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_sparse.compress.guard import Interval, change, judge, mean_interval, tolerance
from sb3_sparse.errors import ConfigError


def test_an_interval_by_hand():
    # 1 to 5: mean 3, standard deviation sqrt(2.5), t(0.975, 4) = 2.776445
    interval = mean_interval([1, 2, 3, 4, 5])
    half = 2.776445 * np.sqrt(2.5) / np.sqrt(5)
    assert interval.mean == 3.0
    assert interval.low == pytest.approx(3 - half, rel=1e-6)
    assert interval.high == pytest.approx(3 + half, rel=1e-6)


def test_the_change_is_that_of_a_paired_t_test():
    stats = pytest.importorskip("scipy.stats")
    generator = np.random.default_rng(0)
    baseline = generator.normal(100, 20, 40)
    sparse = baseline + generator.normal(-2, 3, 40)
    theirs = stats.ttest_rel(sparse, baseline).confidence_interval(0.95)
    ours = change(sparse.tolist(), baseline.tolist())
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high))
    welch = stats.ttest_ind(sparse, baseline, equal_var=False).confidence_interval(0.95)
    assert ours.high - ours.low < 0.25 * (welch.high - welch.low)


def test_identical_returns_leave_nothing_open():
    assert change([500.0] * 5, [500.0] * 5) == Interval(0.0, 0.0, 0.0)
    assert judge(change([500.0] * 5, [500.0] * 5), 0.0) == "passed"
    assert judge(change([480.0] * 5, [500.0] * 5), 15.0) == "failed"


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [
        (-3.0, 1.0, "passed"),
        (2.0, 3.0, "passed"),
        (-3.1, 1.0, "undecided"),
        (-9.0, -3.0, "undecided"),
        (-9.0, -3.1, "failed"),
    ],
)
def test_the_verdict_follows_from_the_ends_of_the_interval(low, high, verdict):
    assert judge(Interval((low + high) / 2, low, high), 3.0) == verdict


def test_the_largest_drop_is_a_share_of_the_absolute_mean():
    assert tolerance([-150.0, -250.0, -200.0], 0.03) == pytest.approx(6.0)
    with pytest.raises(ConfigError, match=r"-?0.00 \[.*cannot be told from 0, so a drop by 3.00%"):
        tolerance([-1.0, 1.0, -2.0, 2.0], 0.03)
    with pytest.raises(ConfigError, match="cannot be told from 0"):
        tolerance([0.0, 0.0], 0.03)


def test_intervals_cover_the_truth_as_often_as_they_say():
    generator = np.random.default_rng(1)
    samples = generator.normal(2.0, 5.0, (2000, 12))
    covered = sum(
        interval.low <= 2.0 <= interval.high for interval in map(mean_interval, samples.tolist())
    )
    # binomial(2000, 0.95): standard deviation 9.7
    assert abs(covered - 1900) < 40


def test_a_drop_beyond_the_tolerance_passes_at_one_look_as_seldom_as_they_say():
    generator = np.random.default_rng(2)
    passed = 0
    for _ in range(2000):
        differences = generator.normal(-3.0, 4.0, 20).tolist()  # truly at the edge
        passed += judge(mean_interval(differences), 3.0) == "passed"
    assert 20 <= passed <= 80  # 2.5 % of 2000 are 50, standard deviation 7


def test_shares_are_written_with_their_sign():
    assert Interval(-3.0, -6.0, 1.5).share_of(-150.0) == "-2.00 % [-4.00 %, +1.00 %]"
    assert Interval(1.0, 0.0, 2.0).share_of(0.0) == "of a return of 0"
