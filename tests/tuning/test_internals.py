"""Optuna's private names stand in one module, which was checked against one version."""

from __future__ import annotations

import re
from importlib.metadata import version
from pathlib import Path

import pytest

from sb3_sparse.tuning.backend import optuna
from sb3_sparse.tuning.choices import PRUNERS, SAMPLERS, SPACES
from sb3_sparse.tuning.internals import CHECKED, CachedStorage, SignsOfLife, id_of
from sb3_sparse.tuning.samplers import PRUNERS as MADE_PRUNERS
from sb3_sparse.tuning.samplers import SAMPLERS as MADE_SAMPLERS
from sb3_sparse.tuning.spacefile import SHIPPED
from sb3_sparse.tuning.storage import open_storage

ROOT = Path(__file__).parents[2]
PRIVATE = re.compile(
    r"optuna[.\w]*\._\w|import _\w|\._(trial_id|study_id|lock|storage)\b|_get_stale"
)


def test_no_other_module_names_what_is_private():
    found = {
        path.name
        for path in (ROOT / "sb3_sparse" / "tuning").glob("*.py")
        if PRIVATE.search(path.read_text())
    }
    assert found == {"internals.py"}


def test_the_checked_version_is_the_one_that_the_tests_ran_with():
    """After an update: read Optuna's changes, run these tests, and write the version down."""
    assert f"optuna=={CHECKED}\n" in (ROOT / "constraints.txt").read_text()
    if version("optuna") != CHECKED:
        pytest.skip(f"another version is installed than the {CHECKED} of constraints.txt")


def test_optuna_puts_this_cache_before_a_database_and_none_before_ours(tmp_path):
    url = f"sqlite:///{tmp_path}/studies.db"
    assert type(optuna.storages.get_storage(url)) is CachedStorage
    ours = open_storage(url)
    assert isinstance(ours, CachedStorage)
    assert optuna.storages.get_storage(ours) is ours


def test_optuna_asks_a_storage_with_signs_of_life_for_its_stale_trials(tmp_path):
    storage = open_storage(tmp_path / "journal.log", heartbeat=1)
    assert isinstance(storage, SignsOfLife)
    study = optuna.create_study(storage=storage)
    study.add_trial(optuna.create_trial(state=optuna.trial.TrialState.WAITING))
    with pytest.warns(UserWarning, match="Heartbeat"):
        trial = study.ask()
    storage.stale_trials = lambda study_id: study.get_trials()
    optuna.storages.fail_stale_trials(study)
    first, again = study.get_trials()
    assert id_of(first) == trial._trial_id
    assert [first.state.name, again.state.name] == ["FAIL", "WAITING"]


def test_the_names_that_are_known_without_optuna_are_those_that_are_made():
    assert tuple(MADE_SAMPLERS) == SAMPLERS
    assert tuple(MADE_PRUNERS) == PRUNERS
    assert tuple(SHIPPED) == SPACES
