"""The commit that a run's record names: that of the code that was loaded, or none."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest
from zoo.test_train import DQN_RUN, Stop

from sb3_sparse.zoo import versions
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.prepare import prepare
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.training import resume, train
from sb3_sparse.zoo.versions import commit_of

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
FILES = ("sb3_sparse/__init__.py", "sb3_sparse/zoo/__init__.py", "results.jsonl")


def git(folder: Path, *words: str) -> str:
    nobody = ["-c", "user.name=Nobody", "-c", "user.email=nobody@example.org"]
    command = ["git", *nobody, "-c", "commit.gpgsign=false", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout


@pytest.fixture
def package(tmp_path, monkeypatch):
    """The package in a checkout of its own."""
    for name in [name for name in os.environ if name.startswith("GIT_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", os.devnull)
    root = tmp_path / "checkout"
    for name in FILES:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("0\n")
    shutil.copy(versions.__file__, root / "sb3_sparse/zoo")
    git(root, "init", "--quiet")
    git(root, "add", ".")
    git(root, "commit", "--quiet", "--message", "First")
    return root / "sb3_sparse"


def head(package: Path) -> str:
    found = git(package, "rev-parse", "HEAD")[:12]
    assert len(found) == 12
    return found


def test_a_checkout_has_the_commit_that_is_checked_out(package):
    assert commit_of(package) == head(package)


@pytest.mark.parametrize("name", FILES)
def test_only_changes_of_the_package_are_told(package, name):
    (package.parent / name).write_text("1\n")
    (package / "new.py").write_text("nobody imports it\n")
    told = " changed" if name.startswith("sb3_sparse/") else ""
    assert commit_of(package) == head(package) + told
    git(package, "add", name.removeprefix("sb3_sparse/") if told else "../" + name)
    assert commit_of(package) == head(package) + told
    git(package, "commit", "--quiet", "--message", "Second")
    assert commit_of(package) == head(package)


def test_a_file_that_is_written_anew_with_the_same_content_is_no_change(package):
    os.utime(package / "__init__.py", (1, 1))
    assert commit_of(package) == head(package)


def test_nothing_is_written_into_the_repository(package):
    os.utime(package / "__init__.py", (1, 1))  # git would write the new time into its index
    index = package.parent / ".git/index"
    before = index.read_bytes()
    commit_of(package)
    assert index.read_bytes() == before


def test_the_commit_is_that_of_the_code_that_was_loaded(package):
    spec = spec_from_file_location("loaded", package / "zoo/versions.py")
    loaded = module_from_spec(spec)
    spec.loader.exec_module(loaded)
    first = head(package)
    (package / "__init__.py").write_text("1\n")
    git(package, "commit", "--quiet", "--all", "--message", "Second")
    assert head(package) != first
    assert loaded.versions()["commit"] == first


def test_a_package_in_an_environment_in_a_repository_of_something_else_has_none(package):
    inside = package.parent / ".venv/lib/site-packages/sb3_sparse"
    shutil.copytree(package, inside)
    assert commit_of(inside) is None


def test_a_package_outside_all_repositories_has_none(package, tmp_path):
    outside = tmp_path / "site-packages/sb3_sparse"
    shutil.copytree(package, outside)
    assert commit_of(outside) is None


def test_a_repository_without_a_commit_has_none(package):
    shutil.rmtree(package.parent / ".git")
    git(package.parent, "init", "--quiet")
    git(package.parent, "add", ".")
    assert commit_of(package) is None


def test_a_repository_that_the_environment_names_is_not_asked(package, tmp_path, monkeypatch):
    """As in a hook of git."""
    other = tmp_path / "other"
    shutil.copytree(package, other / "sb3_sparse")
    git(other, "init", "--quiet")
    git(other, "add", ".")
    git(other, "commit", "--quiet", "--message", "Other")
    wanted = head(package)
    monkeypatch.setenv("GIT_DIR", str(other / ".git"))
    monkeypatch.setenv("GIT_WORK_TREE", str(other))
    assert commit_of(package) == wanted


@pytest.mark.parametrize(
    "program",
    ["#!/bin/sh\nexec sleep 600\n", "#!/bin/sh\necho 0123456789abcdef\nexit 128\n", None],
    ids=["hangs", "fails", "missing"],
)
def test_without_a_git_that_answers_there_is_none(package, tmp_path, monkeypatch, program):
    folder = tmp_path / "bin"
    folder.mkdir()
    if program is not None:
        (folder / "git").write_text(program)
        (folder / "git").chmod(0o755)
        (folder / "sleep").symlink_to(shutil.which("sleep"))
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setattr(versions, "TIMEOUT", 0.2)
    assert commit_of(package) is None


ORIGIN = {
    "url": "https://example.org/repo.git",
    "vcs_info": {"vcs": "git", "commit_id": "c0ffee" * 6},
}
LOCAL = {"url": "file:///somewhere", "dir_info": {"editable": True}}


def install(folder: Path, origin: object) -> None:
    """Write an installation's metadata."""
    metadata = folder / "sb3_sparse-0.1.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: sb3-sparse\nVersion: 0.1\n")
    if origin is not None:
        (metadata / "direct_url.json").write_text(json.dumps(origin))


def test_an_installation_from_a_repository_has_the_commit_of_its_metadata(
    package, tmp_path, monkeypatch
):
    site = tmp_path / "site"
    install(site, ORIGIN)
    shutil.copytree(package, site / "sb3_sparse")
    monkeypatch.syspath_prepend(site)
    assert commit_of(site / "sb3_sparse") == "c0ffeec0ffee"
    # the metadata are of another copy than the one that is loaded
    assert commit_of(package) == head(package)


@pytest.mark.parametrize("origin", [None, LOCAL, [], {"vcs_info": None}])
def test_other_metadata_leave_it_to_git(package, monkeypatch, origin):
    install(package.parent, origin)
    monkeypatch.syspath_prepend(package.parent)
    assert commit_of(package) == head(package)


@pytest.mark.parametrize("commit", ["0123456789ab changed", None])
def test_the_record_has_the_commit_or_lacks_it(tmp_path, monkeypatch, commit):
    monkeypatch.setattr(versions, "COMMIT", commit)
    run = RunSpec(n_timesteps=100)
    found = prepare(run, tmp_path).record(run)["versions"]
    assert {"python", "sb3-sparse", "torch"} <= set(found)
    assert found.get("commit") == commit
    assert ("commit" in found) == (commit is not None)


FIRST, SECOND = "0123456789ab", "ba9876543210"


@pytest.mark.parametrize(
    ("before", "now", "after"),
    [
        (FIRST, FIRST, FIRST),
        (FIRST, SECOND, f"{FIRST}, then {SECOND}"),
        (f"{FIRST}, then {SECOND}", SECOND, f"{FIRST}, then {SECOND}"),
        (f"{FIRST}, then {SECOND}", FIRST, f"{FIRST}, then {SECOND}, then {FIRST}"),
        (None, FIRST, f"unknown, then {FIRST}"),  # began by an older version
        (FIRST, None, FIRST),
    ],
)
def test_a_continued_run_has_the_commits_of_all_its_processes(monkeypatch, before, now, after):
    monkeypatch.setattr(versions, "COMMIT", now)
    known = {**versions.versions(), "torch": "0.1"}
    known.pop("commit", None)
    if before is not None:
        known["commit"] = before
    found = versions.continued(known)
    assert found["commit"] == after
    assert found["torch"] == f"0.1, then {versions.version('torch')}"
    assert found["python"] == known["python"]


def test_a_resumed_run_names_both_commits(tmp_path, monkeypatch):
    monkeypatch.setattr(versions, "COMMIT", FIRST)
    stopped = train(DQN_RUN, tmp_path, [Stop(250)])
    monkeypatch.setattr(versions, "COMMIT", SECOND)
    resume(stopped.folder)
    record = RunFolder(stopped.folder).record()
    assert (record["status"], record["versions"]["commit"]) == (
        "finished",
        f"{FIRST}, then {SECOND}",
    )


def test_a_run_that_begins_anew_names_the_second_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(versions, "COMMIT", FIRST)
    stopped = train(DQN_RUN, tmp_path, [Stop(250)])
    RunFolder(stopped.folder).clear_checkpoints()
    monkeypatch.setattr(versions, "COMMIT", SECOND)
    resume(stopped.folder)
    assert RunFolder(stopped.folder).record()["versions"]["commit"] == SECOND
