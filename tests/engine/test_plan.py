from __future__ import annotations

import pytest

from sb3_sparse.engine.plan import Plan
from sb3_sparse.errors import ConfigError

GOOD = dict(
    method="rigl", update_interval=100, drop_fraction=0.5, begin=0.0, end=0.8, update_on="step"
)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (dict(method="riggle"), "unknown method 'riggle'.*; allowed are .*prune.*rigl.*set"),
        (dict(update_interval=0), "1 or more, got 0"),
        (dict(update_interval=2.5), "whole number of gradient steps, 1 or more, got 2.5"),
        (dict(update_interval=True), "got True"),
        (dict(drop_fraction=1.5), r"\[0, 1\], got 1.5"),
        (dict(drop_fraction=-0.1), "got -0.1"),
        (dict(drop_fraction="half"), "got 'half'"),
        (dict(begin=0.8, end=0.8), "begin < end"),
        (dict(begin=-0.1), "begin=-0.1"),
        (dict(end=1.1), "end=1.1"),
        (dict(update_on="epoch"), "one of step, rollout, got 'epoch'"),
    ],
)
def test_values_that_are_not_allowed_are_named_with_what_is(wrong, message):
    with pytest.raises(ConfigError, match=message):
        Plan(**{**GOOD, **wrong})


def test_due_at_multiples_of_the_interval_within_begin_and_end():
    plan = Plan(**{**GOOD, "begin": 0.2})
    assert plan.due(100, 0.2)
    assert plan.due(300, 0.79)
    assert not plan.due(101, 0.5)
    assert not plan.due(100, 0.19)
    assert not plan.due(100, 0.8)


def test_drop_fraction_starts_full_halves_in_the_middle_and_ends_at_zero():
    plan = Plan(**GOOD)
    assert plan.drop_fraction_at(0.0) == 0.5
    assert plan.drop_fraction_at(0.4) == pytest.approx(0.25)
    assert plan.drop_fraction_at(0.8) == 0.0
    assert Plan(**{**GOOD, "method": "prune"}).drop_fraction_at(0.3) == 0.0
