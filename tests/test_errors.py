from __future__ import annotations

from pathlib import Path

import pytest
from support import make

from sb3_sparse import SparsityCallback
from sb3_sparse.errors import SparsityWarning, warn


@pytest.mark.parametrize("package", ["sb3_sparse.engine.plan", "stable_baselines3.ppo.ppo"])
def test_a_warning_points_at_the_line_that_called_the_library(package):
    library = {"__name__": package, "warn": warn}
    exec("def learn():\n    warn('something')", library)
    with pytest.warns(SparsityWarning, match="^something$") as given:
        library["learn"]()
    assert (given[0].filename, _line(given[0])) == (__file__, 'library["learn"]()')


def test_a_schedule_that_never_came_due_is_said_at_the_line_that_trains():
    model = make("PPO", "CartPole-v1")
    with pytest.warns(SparsityWarning, match="had no mask update") as given:
        model.learn(32, callback=SparsityCallback("rigl", update_interval=10_000))
    assert _line(given[0]).startswith("model.learn(32")


def _line(warning) -> str:
    return Path(warning.filename).read_text().splitlines()[warning.lineno - 1].strip()
