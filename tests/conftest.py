from __future__ import annotations

import gc
import os
import signal

import pytest
import support  # which also registers environments and a third-party method
import torch as th

from sb3_sparse.engine.native import library

th.set_num_threads(1)
os.environ["OMP_NUM_THREADS"] = "1"  # of the processes that tests start
gc.freeze()  # so that collections pass over all that was imported
# A suite that a script starts in the background ignores Ctrl-C, and what it starts would, too.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(params=library.instruction_sets())
def instructions(request):
    """One instruction set after the other."""
    before = library.in_use()
    library.use(request.param)
    yield request.param
    library.use(before)


@pytest.fixture(scope="session")
def watched_kernels(tmp_path_factory):
    """Kernels that the address sanitizer watches; the processes of a test run share them."""
    from building import compile_watched
    from filelock import FileLock

    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    path = folder / "watched.so"
    with FileLock(folder / "watched.lock"):
        if not path.exists():
            compile_watched(path)
    return path


@pytest.fixture(autouse=True)
def distributions_check_their_arguments(monkeypatch):
    """As by default: torch.compile, which some tests use, turns it off for the whole process."""
    monkeypatch.setattr(th.distributions.Distribution, "_validate_args", True)


@pytest.fixture
def sb3_sparse(tmp_path, monkeypatch, capsys):
    """Runs a command in the test's folder, and gives its exit code, its output, and its errors."""

    def call(*args: str) -> tuple[int, str, str]:
        monkeypatch.chdir(tmp_path)
        return support.run_command(monkeypatch, capsys, *args)

    return call


@pytest.fixture
def mistake(sb3_sparse):
    """Runs a command that must end with an error of the user's, and gives its one line."""

    def call(*args: str) -> str:
        code, _, errors = sb3_sparse(*args)
        assert code == 2
        (line,) = errors.strip().splitlines()
        assert line.startswith("Error: ")
        return line

    return call
