"""Optuna's verbosity and Python's warning filters belong to the user."""

from __future__ import annotations

import subprocess
import sys
import warnings

import pytest
from tuning_support import choices, small_run

from sb3_sparse.launch import Launcher
from sb3_sparse.tuning import tune
from sb3_sparse.tuning.backend import optuna, quiet_optuna


class NoWorkers(Launcher):
    """Shows how Optuna stands while a study is made."""

    def run(self, tasks, workers):
        self.seen = optuna.logging.get_verbosity()
        yield from ()


@pytest.fixture(params=[optuna.logging.DEBUG, optuna.logging.ERROR])
def verbosity(request):
    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(request.param)
    yield request.param
    optuna.logging.set_verbosity(before)


def test_importing_changes_neither_verbosity_nor_filters():
    code = """
import warnings, optuna
import torch, stable_baselines3, rl_zoo3, matplotlib, ruamel.yaml, sqlalchemy
before = optuna.logging.get_verbosity(), [one for one in warnings.filters if "ptuna" in str(one)]
import sb3_sparse.tuning
after = optuna.logging.get_verbosity(), [one for one in warnings.filters if "ptuna" in str(one)]
assert before == after, (before, after)
assert not any("Choices" in str(one) or "GridSampler" in str(one) for one in warnings.filters)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_tuning_is_quiet_and_puts_back_what_was(verbosity, tmp_path, capfd):
    filters, launcher = list(warnings.filters), NoWorkers()
    tune(small_run(), choices(weight_decay=[0.0]), log_folder=tmp_path, launcher=launcher)
    assert launcher.seen == max(verbosity, optuna.logging.WARNING)
    assert optuna.logging.get_verbosity() == verbosity
    assert warnings.filters == filters
    assert "A new study created" not in capfd.readouterr().err


def test_what_fails_within_puts_it_back_too(verbosity):
    with pytest.raises(RuntimeError, match="here"), quiet_optuna():
        raise RuntimeError("here")
    assert optuna.logging.get_verbosity() == verbosity
