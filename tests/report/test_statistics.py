from __future__ import annotations

import numpy as np
import pytest
import scipy.stats
from rliable import metrics

from sb3_sparse.intervals import mean_interval
from sb3_sparse.report.statistics import (
    difference,
    improvement,
    iqm,
    iqm_estimates,
    mean,
    profile,
    rectangle,
)

SCORES = np.random.default_rng(1).normal(size=(8, 3)) + [0.0, 1.0, 3.0]
OTHERS = np.random.default_rng(2).normal(size=(6, 3)) + [0.5, 1.0, 2.0]


def test_the_iqm_is_the_mean_of_the_middle_half():
    assert iqm(np.array([[0.0, 1.0], [3.0, 1000.0]])) == 2.0
    for count in range(1, 25):
        scores = np.random.default_rng(count).normal(size=(count, 1))
        assert iqm(scores) == pytest.approx(scipy.stats.trim_mean(scores.ravel(), 0.25))
        assert iqm(scores) == pytest.approx(metrics.aggregate_iqm(scores))


def test_the_interval_of_the_iqm_is_that_of_a_stratified_bootstrap_done_by_hand():
    rng = np.random.default_rng(5)
    drawn = SCORES[rng.integers(0, 8, (4000, 8, 3)), np.arange(3)].reshape(4000, -1)
    by_hand = np.percentile(scipy.stats.trim_mean(drawn, 0.25, axis=1), [2.5, 97.5])
    estimate = iqm_estimates({"it": SCORES})["it"]
    assert (estimate.seeds, estimate.tasks) == (8, 3)
    assert [estimate.low, estimate.high] == pytest.approx(by_hand, abs=0.05)


def test_estimates_are_the_same_each_time_and_leave_numpys_generator_alone():
    np.random.seed(7)
    expected = np.random.rand()
    np.random.seed(7)
    assert iqm_estimates({"it": SCORES}, 200) == iqm_estimates({"it": SCORES}, 200)
    assert np.random.rand() == expected


def test_the_probability_of_improvement_is_mann_whitneys_u():
    expected = np.mean(
        [
            scipy.stats.mannwhitneyu(SCORES[:, task], OTHERS[:, task]).statistic / 48
            for task in range(3)
        ]
    )
    assert improvement(SCORES, OTHERS, 50).value == pytest.approx(expected)
    assert metrics.probability_of_improvement(SCORES, OTHERS) == pytest.approx(expected)


def test_ties_count_half_and_a_sure_improvement_is_one():
    assert improvement(np.ones((3, 2)), np.ones((4, 2)), 20).value == 0.5
    sure = improvement(np.ones((3, 2)), np.zeros((4, 2)), 20)
    assert (sure.value, sure.low, sure.high) == (1.0, 1.0, 1.0)


def test_a_profile_is_the_share_of_runs_above_each_threshold():
    values, low, high = profile(np.array([[0.0, 1.0], [2.0, 3.0]]), np.array([-1, 0.5, 2.5]), 50)
    assert values.tolist() == [1.0, 0.75, 0.25]
    assert (low <= values).all()
    assert (values <= high).all()


def test_the_widened_interval_has_the_factors_of_few_seeds():
    x, y = SCORES[:3], OTHERS[:3]
    plain = scipy.stats.t.ppf(0.975, 3 * 4) / scipy.stats.norm.ppf(0.975) * np.sqrt(3 / 2)
    wide = difference(x, y, lambda a: float(a.mean()))
    rng = np.random.default_rng(0)

    def drawn(scores):
        return scores[rng.integers(0, 3, (20000, 3, 3)), np.arange(3)].mean((1, 2))

    low, high = np.percentile(drawn(x) - drawn(y), [2.5, 97.5])
    assert wide.value == pytest.approx(x.mean() - y.mean())
    assert wide.low == pytest.approx(wide.value - plain * (wide.value - low), abs=0.15)
    assert wide.high == pytest.approx(wide.value + plain * (high - wide.value), abs=0.15)


@pytest.mark.parametrize(("tasks", "seeds"), [(1, 3), (3, 5)])
def test_the_interval_of_verdicts_covers_the_truth_95_times_in_100(tasks, seeds):
    rng = np.random.default_rng(11)
    runs = 150
    covered = 0
    for _ in range(runs):
        x, y = rng.normal(size=(2, seeds, tasks))
        estimate = difference(x + 1.0, y, lambda a: float(a.mean()), reps=150)
        covered += estimate.low <= 1.0 <= estimate.high
    # no fewer than a binomial variable of 95 % allows; 1 in 1,000
    assert covered >= scipy.stats.binom.ppf(0.001, runs, 0.95)


def test_the_plain_iqm_interval_covers_the_truth_with_twenty_seeds():
    rng = np.random.default_rng(3)
    covered = 0
    for _ in range(60):
        estimate = iqm_estimates({"it": rng.normal(size=(20, 3))}, 200)["it"]
        covered += estimate.low <= 0.0 <= estimate.high
    assert covered >= scipy.stats.binom.ppf(0.001, 60, 0.95)


def test_means_have_students_interval_and_one_seed_has_none():
    values = [1.0, 2.0, 6.0]
    expected = scipy.stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    estimate = mean(values)
    assert (estimate.low, estimate.high) == pytest.approx((expected.low, expected.high))
    middle, low, _ = mean_interval(np.array([[1.0, 2.0]]))
    assert middle.tolist() == [1.0, 2.0]
    assert np.isnan(low).all()


def test_a_rectangle_takes_the_lowest_seeds_and_says_what_it_leaves_out():
    made = rectangle({"a": [1.0, 2.0, 3.0], "b": [4.0, 5.0], "c": [6.0]})
    assert made.scores.tolist() == [[1.0, 4.0], [2.0, 5.0]]
    assert made.tasks == ("a", "b")
    assert made.remarks == ("c: 1 run, of 2 needed", "a: 1 run of the highest seeds not used")
    assert rectangle({"c": [6.0]}) is None
