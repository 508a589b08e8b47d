"""The compiled library: how it is built, found and kept within bounds."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from sb3_sparse.engine.native import library
from sb3_sparse.errors import ConfigError, MissingKernels, SparsityError, SparsityWarning

ROOT = Path(__file__).parents[2]
SOURCES = ROOT / "sb3_sparse" / "engine" / "native"
NEEDS_COMPILER = pytest.mark.skipif(
    shutil.which("gcc") is None, reason="needs gcc (apt install gcc) for its address sanitizer"
)


def build_hook():
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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


def built_wheel(folder: Path, **environment: str) -> tuple[str, list[str], str]:
    """Name and files of a wheel built in a copy of the sources, and what was said."""
    source = folder / "source"
    for name in ("pyproject.toml", "README.md", "LICENSE", "hatch_build.py"):
        source.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "zoo_hparams", source / "zoo_hparams")
    shutil.copytree(ROOT / "sb3_sparse", source / "sb3_sparse")
    done = subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)],
        cwd=source, env={**os.environ, **environment}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return wheel.name, archive.namelist(), done.stdout + done.stderr


@NEEDS_COMPILER
def test_the_wheel_has_the_library_and_is_tied_to_no_python(tmp_path):
    name, files, _ = built_wheel(tmp_path)
    assert name.split("-")[2:4] == ["py3", "none"]
    assert not name.endswith("any.whl")
    assert "linux" not in name or "-linux_" in name  # auditwheel decides on manylinux
    assert "sb3_sparse/engine/native/kernels.so" in files
    assert "sb3_sparse/engine/native/kernels.c" in files


def test_without_a_compiler_there_is_a_wheel_without_the_library(tmp_path):
    name, files, said = built_wheel(tmp_path, CC="no-such-compiler")
    assert name.endswith("-py3-none-any.whl")
    assert "sb3_sparse/engine/native/kernels.so" not in files
    assert "the sparse kernels were not compiled" in said


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory):
    """Runs a program on kernels that the address sanitizer watches."""
    made = tmp_path_factory.mktemp("sanitized") / "kernels.so"
    build_hook().compile_kernels(SOURCES, made, ("-fsanitize=address", "-g", "-O1"))
    runtime = subprocess.run(
        ["gcc", "-print-file-name=libasan.so"], check=True, capture_output=True, text=True
    ).stdout.strip()
    environment = {**os.environ, "LD_PRELOAD": runtime, "ASAN_OPTIONS": "detect_leaks=0"}

    def run(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, str(Path(__file__).with_name(program)), str(made), *arguments],
            env=environment, capture_output=True, text=True,
        )  # fmt: skip

    return run


@NEEDS_COMPILER
@pytest.mark.parametrize("program", ["bounds.py", "image_bounds.py"])
@pytest.mark.parametrize("instructions", library.instruction_sets())
def test_the_kernels_stay_within_bounds_under_the_address_sanitizer(
    sanitized, instructions, program
):
    done = sanitized(program, instructions)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.split()[-1] == "passes"
    # The same with one connection or place beyond the end: it must be noticed.
    broken = sanitized(program, instructions, "x")
    assert "AddressSanitizer: heap-buffer-overflow" in broken.stderr
