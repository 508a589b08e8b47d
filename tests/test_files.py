"""Files are written whole or not at all; tables are CSV files of one form."""

from __future__ import annotations

import os
import stat
import sys

import pytest

from sb3_sparse.files import write_csv, written_whole


def test_the_new_file_takes_the_place_of_the_old_one_at_the_end(tmp_path):
    path = tmp_path / "scores.txt"
    path.write_text("old")
    with written_whole(path) as new:
        new.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "scores.txt"
    path.write_text("old")

    def fail():
        with written_whole(path) as new:
            new.write_text("hal")
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_two_possible_algorithms_one_file_do_not_meet(tmp_path):
    path = tmp_path / "scores.txt"
    with written_whole(path) as first, written_whole(path) as second:
        first.write_text("first")
        second.write_text("second")
    assert path.read_text() == "first"  # which ended last
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX permissions and links")
def test_permissions_and_links_stay(tmp_path):
    path, link = tmp_path / "scores.txt", tmp_path / "link.txt"
    path.write_text("old")
    path.chmod(0o640)
    link.symlink_to(path)
    with written_whole(link) as new:
        new.write_text("new")
    assert link.is_symlink()
    assert path.read_text() == "new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX permissions")
def test_a_first_file_has_the_permissions_that_open_gives(tmp_path):
    before = os.umask(0o027)
    try:
        with written_whole(tmp_path / "scores.txt") as new:
            new.write_text("new")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "scores.txt").stat().st_mode) == 0o640


@pytest.mark.skipif(sys.platform == "win32", reason="files are synced on POSIX alone")
def test_the_content_is_on_the_disk_before_it_has_the_name(tmp_path, monkeypatch):
    path, seen = tmp_path / "scores.txt", []
    monkeypatch.setattr(os, "fsync", lambda _: seen.append(path.exists()))
    with written_whole(path) as new:
        new.write_text("new")
    assert seen == [False]


def test_a_table_is_exact_without_digits(tmp_path):
    path = tmp_path / "table.csv"
    write_csv(path, ["step", "value"], [(1, 0.1 + 0.2), (2, None), ("a,b", float("nan"))])
    assert path.read_bytes() == b'step,value\n1,0.30000000000000004\n2,\n"a,b",nan\n'


def test_digits_round_floats_and_leave_no_nan(tmp_path):
    path = tmp_path / "table.csv"
    write_csv(path, ["step", "value"], [(123456, 1234.5678), (True, float("nan"))], digits=3)
    assert path.read_text() == "step,value\n123456,1.23e+03\nTrue,\n"
