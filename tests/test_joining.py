"""What contributors are told is true: snippets run, versions agree, files are well-formed."""

from __future__ import annotations

import re
import shutil
import subprocess
import textwrap
from pathlib import Path

import pytest
import yaml
from support import assert_masked, make
from test_architecture import FLOORS

import sb3_sparse
from sb3_sparse import SparsityCallback
from sb3_sparse.studies import Study
from sb3_sparse.topology import registry

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "CONTRIBUTING.md").read_text()
OUTSIDE = {"lazy", "rl_zoo_optimize"}  # parts that the picture leaves out


def fenced(language: str) -> list[str]:
    found = re.findall(rf"^( *)```{language}\n(.*?)^ *```$", TEXT, re.DOTALL | re.MULTILINE)
    return [textwrap.dedent(code) for _, code in found]


def pinned(package: str) -> str:
    (version,) = re.findall(
        rf"^{package}==(\S+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE
    )
    return version


def test_the_picture_has_every_part_on_its_floor():
    (picture,) = fenced("text")
    drawn = [set(line[:48].split()) for line in picture.splitlines()]
    wanted = [floor - OUTSIDE for floor in FLOORS]
    merged = [floor for floor in wanted if floor and not floor <= {"files", "intervals", "errors"}]
    last = merged.pop() | {"files", "intervals", "errors"}
    assert drawn == [*merged, last]


def test_the_method_trains_and_moves_masks(monkeypatch):
    monkeypatch.setattr(registry, "_METHODS", dict(registry._METHODS))
    code, _ = fenced("python")
    exec(compile(code, "CONTRIBUTING.md", "exec"), {"__name__": "preferential"})
    model = make("SAC")
    before = [layer.mask() for layer in model.policy.sparse.layers]
    model.learn(100, callback=SparsityCallback("preferential", update_interval=5))
    layers = model.policy.sparse.layers
    assert any((a.mask() != b).any() for a, b in zip(layers, before, strict=True))
    assert_masked(model)


def test_the_study_is_one(tmp_path):
    (content,) = fenced("yaml")
    path = tmp_path / "dropped.yml"
    path.write_text(content)
    small, paper = (Study.read(str(path), scale).cells for scale in ("small", "paper"))
    assert (len(small), len(paper)) == (3 * 3, 3 * 10)


def test_files_that_are_named_exist():
    for target in re.findall(r"\]\(([^)#]+)", TEXT):
        assert (ROOT / target).exists(), target
    for path in re.findall(r"`((?:sb3_sparse|tests|docs|benchmarks|zoo_hparams)/[\w/.]*)`", TEXT):
        assert (ROOT / path).exists() or "preferential" in path, path


def test_hooks_check_with_the_pinned_versions():
    (repo,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    hooks = {hook["id"]: hook for hook in repo["hooks"]}
    assert list(hooks) == ["ruff", "ruff-format", "mypy"]
    for name in ("ruff", "ruff-format"):
        assert hooks[name]["additional_dependencies"] == [f"ruff=={pinned('ruff')}"]
    assert hooks["mypy"]["language"] == "system"  # of the environment, at the pinned version


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == sb3_sparse.__version__
    assert citation["license"] == "MIT"


def test_the_changelog_dates_this_version():
    changelog = (ROOT / "CHANGELOG.md").read_text()
    (date,) = re.findall(rf"^## \[{re.escape(sb3_sparse.__version__)}\] - (\S+)$", changelog, re.M)
    assert date == yaml.safe_load((ROOT / "CITATION.cff").read_text())["date-released"]


def test_a_release_is_published_once_all_of_it_is_built():
    jobs = yaml.safe_load((ROOT / ".github/workflows/release.yml").read_text())["jobs"]
    assert sorted(jobs["publish"]["needs"]) == sorted(jobs.keys() - {"publish"})
    assert jobs["publish"]["permissions"] == {"id-token": "write"}


def test_the_workflow_runs_the_script_of_ci_on_linux_and_macos():
    job = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"]["test"]
    assert job["steps"][-1] == {"run": "bash .ci/run"}
    systems = {one["os"].partition("-")[0] for one in job["strategy"]["matrix"]["include"]}
    assert systems == {"ubuntu", "macos"}
    assert "SB3_SPARSE_CI_APT" in job["env"]


def test_templates_of_issues_are_forms():
    paths = sorted((ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml"))
    assert paths
    for path in paths:
        form = yaml.safe_load(path.read_text())
        assert {"name", "description", "body"} <= form.keys(), path.name
        ids = [part["id"] for part in form["body"]]
        assert len(ids) == len(set(ids)), path.name


@pytest.mark.parametrize(
    ("given", "installs"),
    [
        ({}, False),
        ({"SB3_SPARSE_CI_APT": "1"}, True),
        ({"CI": "true"}, True),
        ({"CI": "true", "SB3_SPARSE_CI_APT": "0"}, False),
    ],
)
def test_ci_installs_debian_packages_only_where_it_is_told_to(tmp_path, given, installs):
    script = (ROOT / ".ci/run").read_text()
    (part,) = re.findall(r"^apt=.*?^  needs Chromium chromium$", script, re.DOTALL | re.MULTILINE)
    tools = tmp_path / "bin"
    tools.mkdir()
    for name in ("bash", "id", "ls"):  # a machine that has nothing else
        (tools / name).symlink_to(shutil.which(name))
    for name in ("apt-get", "sudo"):
        (tools / name).write_text(f'#!{tools}/bash\necho "{name} $*"\n')
        (tools / name).chmod(0o755)
    done = subprocess.run(
        [str(tools / "bash"), "-euo", "pipefail", "-c", f"{part}\necho went on"],
        env={"PATH": str(tools), **given},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.endswith("went on\n")
    assert ("install" in done.stdout) == installs
    assert ("qemu-system-arm" in done.stdout) == installs
    assert ("GCC or QEMU for ARM here: its tests will be skipped" in done.stderr) == (not installs)
