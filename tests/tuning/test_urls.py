"""Storages that are neither a path nor a URL are refused, and no password is shown."""

from __future__ import annotations

from pathlib import Path

import pytest
from tuning_support import choices, small_run

from sb3_sparse.errors import ConfigError
from sb3_sparse.tuning import tune
from sb3_sparse.tuning.report import report_by_name
from sb3_sparse.tuning.storage import open_storage
from sb3_sparse.tuning.urls import is_journal

ODD = [
    "postgresql:/u:s3cret@h/db",
    "postgresql:u:s3cret@h/db",
    "postgresql+psycopg:/u:s3cret@h/db",
    "postgresql//u:s3cret@h/db",
    "postgresql/u:s3cret@h/db",
    " postgresql:/u:s3cret@h/db",
    "u:s3cret@h/db",
    ":s3cret@h/db",
    "sqlite:/studies.db",
    "sqlite:studies.db",
    "redis:/:s3cret@h",
    Path("postgresql://u:s3cret@h/db"),
]


@pytest.mark.parametrize("storage", ODD)
def test_what_looks_like_a_url_and_is_none_is_refused_and_makes_nothing(
    storage, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for use in (
        lambda: tune(small_run(), choices(weight_decay=[0.0]), storage=storage),
        lambda: open_storage(storage),
        lambda: report_by_name(["study"], storage, tmp_path, None),
    ):
        with pytest.raises(ConfigError, match="looks like a URL, but is not one; give a") as said:
            use()
        assert "s3cret" not in str(said.value)
    assert list(tmp_path.iterdir()) == []


def test_the_scheme_of_a_database_is_named():
    with pytest.raises(ConfigError, match=r"the storage postgresql:... looks like"):
        is_journal("postgresql:/u:s3cret@h/db")


@pytest.mark.parametrize(
    "path",
    ["journal.log", "logs/tune/journal.log", "/data/me@home/j.log", "C:\\logs\\j.log", "C:/j"],
)
def test_paths_are_journals(path):
    assert is_journal(path)


def test_a_file_that_exists_is_a_journal_whatever_its_name(tmp_path):
    odd = tmp_path / "run:1" / "me@home.log"
    odd.parent.mkdir()
    odd.touch()
    assert is_journal(odd)
    assert is_journal(str(odd))
