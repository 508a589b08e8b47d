"""Errors while a run is set up: one line for the user's, a traceback for this package's own."""

from __future__ import annotations

import importlib

import pytest

import sb3_sparse
from sb3_sparse.errors import ConfigError
from sb3_sparse.zoo.folder import env_name
from sb3_sparse.zoo.prepare import setup_errors


def test_an_error_in_the_users_code_names_its_line(tmp_path, monkeypatch):
    (tmp_path / "users_env.py").write_text("def make():\n    raise TypeError('no size')\n")
    monkeypatch.syspath_prepend(tmp_path)
    make = importlib.import_module("users_env").make
    told = r"^Maze-v0 fails: TypeError: no size \(.*users_env.py, line 2\)$"
    with pytest.raises(ConfigError, match=told), setup_errors("Maze-v0 fails", "Maze-v0"):
        make()


def test_an_error_in_this_package_is_a_bug_and_is_raised_as_it_is():
    with pytest.raises(AttributeError), setup_errors("Maze-v0 fails", "Maze-v0"):
        env_name(3)


def test_a_name_that_this_package_lacks_is_a_typing_mistake_of_the_user():
    with pytest.raises(ConfigError, match="no attribute 'SparsityCalback'$"):  # noqa: SIM117
        with setup_errors("Maze-v0 fails", "Maze-v0"):
            sb3_sparse.SparsityCalback  # noqa: B018
