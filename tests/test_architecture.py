"""Imports only point down, never in a circle, and nothing names a machine."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "sb3_sparse"

# From the top; parts on one line may not import each other either.
FLOORS = [
    {"cli", "rl_zoo_optimize"},
    {"report", "studies", "tuning"},
    {"zoo", "export", "compress", "launch"},
    {"callbacks"},
    {"analysis"},
    {"callback", "algorithms"},
    {"policies"},
    {"networks", "wrappers", "buffers", "loading", "fused"},
    {"engine"},
    {"topology"},
    {"sparsity"},
    {"pages"},
    {"files", "intervals"},
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
    "rich": {"cli"},
    "rl_zoo3": {"zoo", "rl_zoo_optimize"},
    "shimmy": {"zoo"},
    "dm_control": {"zoo"},
    "optuna": {"tuning"},
    "matplotlib": {"pages"},
    "rliable": {"report"},
    "onnx": {"export"},
    "onnxruntime": {"export"},
    "scipy": {"export", "intervals"},
    "ray": {"launch"},
    "sqlalchemy": {"tuning"},
    "ruamel": {"tuning"},
    "sbx": {"loading"},
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
    wrong.write_text("from sb3_sparse.policies.base import BaseSparsePolicy\n")
    assert "sb3_sparse.policies.base" in imports_of(wrong)
    assert HEIGHT["policies"] > HEIGHT["engine"] > HEIGHT["topology"] > HEIGHT["sparsity"]


def modules_of(root: Path) -> dict[str, set[str]]:
    """The modules below a package, and which of them each imports, for types alone too."""
    files = {}
    for path in root.rglob("*.py"):
        parts = path.relative_to(root.parent).with_suffix("").parts
        files[".".join(parts).removesuffix(".__init__")] = path
    found = {}
    for name, path in files.items():
        found[name] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found[name].update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                inner = {f"{node.module}.{alias.name}" for alias in node.names}
                # What is no module of a package is a name in its __init__.
                found[name].update(inner & files.keys())
                found[name].update({node.module} if inner - files.keys() else ())
        found[name] &= files.keys() - {name}
    return found


def circle_in(imports: dict[str, set[str]]) -> list[str]:
    """Modules that import each other in a circle; none if there is no such."""
    left = dict(imports)
    while True:
        ends = {name for name, needs in left.items() if not needs & left.keys()}
        if not ends:
            break
        left = {name: needs for name, needs in left.items() if name not in ends}
    return sorted(left)


def test_no_modules_import_each_other_in_a_circle():
    assert circle_in(modules_of(PACKAGE)) == []


def test_the_checker_sees_a_circle(tmp_path):
    package = tmp_path / "house"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "one.py").write_text("from house import two\n")
    (package / "two.py").write_text("def f():\n    from house.one import name\n")
    (package / "three.py").write_text("import house.one\n")
    assert circle_in(modules_of(package)) == ["house.one", "house.three", "house.two"]
    (package / "two.py").write_text("")
    assert circle_in(modules_of(package)) == []


def test_the_package_is_typed_and_versioned_once():
    import sb3_sparse

    assert (PACKAGE / "py.typed").exists()
    assert f'version = "{sb3_sparse.__version__}"' in (ROOT / "pyproject.toml").read_text()


# What documents and examples may import from; everything else is free to move.
DOORS = {
    "",
    "algorithms",
    "analysis",
    "buffers",
    "callbacks",
    "compress",
    "export",
    "fused",
    "networks",
    "report",
    "sparsity",
    "studies",
    "topology",
    "tuning",
    "wrappers",
    "zoo",
}
MODULES = {"rl_zoo_optimize"}  # which --gym-packages names


def names_used(text: str) -> set[str]:
    """Dotted names of this package that a document or script uses."""
    found = set(re.findall(r"\bsb3_sparse(?:\.\w+)+", text))
    for module, names in re.findall(
        r"^\s*from (sb3_sparse[\w.]*) import (\([^)]*\)|[^\n]*)", text, re.MULTILINE
    ):
        found.discard(module)
        found.update(f"{module}.{name}" for name in re.findall(r"\w+", names))
    return found


def is_public(name: str) -> bool:
    _, *path, last = name.split(".")
    door = ".".join(path)
    if door == "" and last in DOORS | MODULES:
        return True
    if door not in DOORS:  # an attribute of a public class
        return is_public(f"sb3_sparse.{door}")
    return last in getattr(import_module(f"sb3_sparse.{door}".rstrip(".")), "__all__", ())


DOCUMENTS = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "examples").glob("*.py")]


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_documents_use_public_doors_alone(path):
    assert [name for name in sorted(names_used(path.read_text())) if not is_public(name)] == []


def test_the_checker_sees_a_name_behind_a_door():
    text = "from sb3_sparse.zoo.spec import (\n    RunSpec,\n)\nsb3_sparse.zoo.train(run)\n"
    assert names_used(text) == {"sb3_sparse.zoo.spec.RunSpec", "sb3_sparse.zoo.train"}
    assert not is_public("sb3_sparse.zoo.spec.RunSpec")
    assert not is_public("sb3_sparse.zoo.spec")
    assert not is_public("sb3_sparse.zoo.spec.RunSpec.settings")
    assert is_public("sb3_sparse.zoo.train")
    assert is_public("sb3_sparse.zoo.RunSpec.settings")
