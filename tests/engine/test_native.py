"""The compiled library: how it is built, found and kept within bounds."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
from building import NEEDS_COMPILER, built_wheel, run_watched

from sb3_sparse.engine.native import library
from sb3_sparse.errors import ConfigError, MissingKernels, SparsityError, SparsityWarning

ROOT = Path(__file__).parents[2]


@pytest.fixture
def relocated(monkeypatch, tmp_path):
    """The library is looked for elsewhere."""
    path = tmp_path / "kernels.so"
    monkeypatch.setattr(library, "PATH", path)
    library.library.cache_clear()
    yield path
    library.library.cache_clear()


def test_a_missing_library_says_what_is_missing_and_the_cure(relocated):
    with pytest.raises(
        MissingKernels, match="they were not compiled when .* Reinstall .* compute='masked'"
    ):
        library.library()
    assert "were not compiled" in library.why_missing()


def test_sparse_without_kernels_is_an_error_and_auto_trains_with_masks(relocated):
    from support import make

    with pytest.raises(MissingKernels, match="or use compute='masked'"):
        make("SAC", policy_kwargs=dict(compute="sparse"))
    with pytest.warns(SparsityWarning, match="there are no kernels: .* several times as long"):
        model = make("SAC", policy_kwargs=dict(compute="auto", net_arch=[200, 200])).learn(23)
    assert not any(layer.is_sparse for layer in model.policy.sparse.layers)


def test_without_kernels_masks_that_were_asked_for_are_no_surprise(relocated, recwarn):
    from support import make

    make("SAC", policy_kwargs=dict(compute="masked"))
    assert not [one for one in recwarn if issubclass(one.category, SparsityWarning)]


def test_a_damaged_library_does_not_load(relocated):
    relocated.write_bytes(b"no library")
    with pytest.raises(MissingKernels, match="the library does not load"):
        library.library()


def test_a_library_of_another_version_is_rejected(monkeypatch):
    monkeypatch.setattr(library, "VERSION", library.VERSION + 1)
    library.library.cache_clear()
    with pytest.raises(SparsityError, match=r"library has version \d+, this package \d+"):
        library.library()
    library.library.cache_clear()


def test_an_unknown_way_to_compute_is_rejected():
    from support import make

    with pytest.raises(ConfigError, match="compute must be one of 'masked', 'sparse', 'auto'"):
        make("SAC", policy_kwargs=dict(compute="dense"))


def test_the_kernels_share_torchs_threads_where_torch_has_openmp():
    import torch as th

    if not list(Path(th.__file__).parent.glob("lib/libgomp*")):
        pytest.skip("this torch brings no libgomp")
    assert library.library().sb3_sparse_shares_threads() == 1


@NEEDS_COMPILER
def test_the_wheel_has_the_library_and_is_tied_to_no_python(tmp_path):
    quick = "sh -c 'exec gcc \"$@\" -O0' gcc"  # the last level that is given counts
    wheel, _ = built_wheel(tmp_path, CC=quick)
    name, files = wheel.name, zipfile.ZipFile(wheel).namelist()
    assert name.split("-")[2:4] == ["py3", "none"]
    assert not name.endswith("any.whl")
    assert "linux" not in name or "-linux_" in name  # auditwheel decides on manylinux
    assert "sb3_sparse/engine/native/kernels.so" in files
    assert "sb3_sparse/engine/native/kernels.c" in files


def test_without_a_compiler_there_is_a_wheel_without_the_library(tmp_path):
    wheel, said = built_wheel(tmp_path, CC="no-such-compiler")
    assert wheel.name.endswith("-py3-none-any.whl")
    assert "sb3_sparse/engine/native/kernels.so" not in zipfile.ZipFile(wheel).namelist()
    assert "the sparse kernels were not compiled" in said


@NEEDS_COMPILER
@pytest.mark.parametrize("program", ["bounds.py", "image_bounds.py"])
@pytest.mark.parametrize("instructions", library.instruction_sets())
def test_the_kernels_stay_within_bounds_under_the_address_sanitizer(
    watched_kernels, instructions, program
):
    path = Path(__file__).with_name(program)
    done = run_watched(path, watched_kernels, instructions)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.split()[-1] == "passes"
    # The same with one connection or place beyond the end: it must be noticed.
    broken = run_watched(path, watched_kernels, instructions, "x")
    assert "AddressSanitizer: heap-buffer-overflow" in broken.stderr
