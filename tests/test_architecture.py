"""Imports only point down, files stay small, and nothing names a machine."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "sb3_sparse"

# From the top; parts on one line may not import each other either.
FLOORS = [
    {"cli", "rl_zoo_optimize"},
    {"report", "experiments", "tuning"},
    {"zoo", "analysis", "export", "compress", "launch"},
    {"callback", "algorithms"},
    {"policies"},
    {"networks", "wrappers", "loading", "fused"},
    {"engine"},
    {"topology"},
    {"sparsity"},
    {"errors", "lazy"},
]
HEIGHT = {part: -level for level, parts in enumerate(FLOORS) for part in parts}
# What a floor may not know at all.
FORBIDDEN = {
    "sparsity": {"torch", "stable_baselines3", "sb3_contrib", "gymnasium"},
    "topology": {"torch", "stable_baselines3", "sb3_contrib", "gymnasium"},
    "engine": {"stable_baselines3", "sb3_contrib", "gymnasium"},
    "fused": {"stable_baselines3", "sb3_contrib", "gymnasium"},
}
# Each optional dependency has one edge.
EDGES = {
    "sb3_contrib": {"policies"},
    "typer": {"cli"},
    "rich": {"cli", "zoo"},
    "rl_zoo3": {"zoo", "rl_zoo_optimize"},
    "optuna": {"tuning"},
    "matplotlib": {"report"},
    "rliable": {"report"},
    "onnx": {"export"},
    "onnxruntime": {"export"},
    "scipy": {"compress", "export", "report"},
    "ray": {"launch"},
    "sqlalchemy": {"tuning"},
    "plotly": {"tuning"},
    "ruamel": {"tuning"},
}
FILES = sorted(PACKAGE.rglob("*.py"))


def part_of(path: Path) -> str:
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix(".py")


def imports_of(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} uses a relative import"
            found.add(node.module or "")
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path):
    part = part_of(path)
    if part == "__init__":
        return
    assert part in HEIGHT, f"{part} stands on no floor"
    for name in imports_of(path):
        module, *rest = name.split(".")
        if module == "sb3_sparse":
            if rest and rest[0] in HEIGHT and rest[0] != part:
                assert HEIGHT[rest[0]] < HEIGHT[part], f"{path.name} imports {name}"
        else:
            assert module not in FORBIDDEN.get(part, set()), f"{path.name} imports {name}"
            assert part in EDGES.get(module, {part}), f"{path.name} imports {name}"


def test_the_checker_sees_an_arrow_that_points_up(tmp_path):
    wrong = tmp_path / "wrong.py"
    wrong.write_text("from sb3_sparse.policies.mixin import SparsePolicyMixin\n")
    assert "sb3_sparse.policies.mixin" in imports_of(wrong)
    assert HEIGHT["policies"] > HEIGHT["engine"] > HEIGHT["topology"] > HEIGHT["sparsity"]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_file_holds_one_concept(path):
    assert len(path.read_text().splitlines()) <= 300


def test_the_package_is_typed_and_versioned_once():
    import sb3_sparse

    assert (PACKAGE / "py.typed").exists()
    assert f'version = "{sb3_sparse.__version__}"' in (ROOT / "pyproject.toml").read_text()
