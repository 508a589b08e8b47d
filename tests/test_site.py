"""The site of the documentation: it builds without a warning, links work, nothing is fetched."""

from __future__ import annotations

import html
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from urllib.parse import unquote

import pytest
import yaml
from test_architecture import DOORS

from sb3_sparse import topology

ROOT = Path(__file__).parent.parent


def hook(name: str) -> ModuleType:
    """A module of docs/site."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / "site" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built without a network: a proxy that nobody answers stands for it."""
    folder = tmp_path_factory.mktemp("site")
    nobody = dict.fromkeys(
        ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"), "http://[::1]:9"
    )
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, **nobody}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return folder


def pages_of(site: Path) -> dict[Path, str]:
    return {path: path.read_text() for path in site.rglob("*.html") if "results" not in path.parts}


def words_of(page: str) -> str:
    """The text of a page's article."""
    article = page[page.index("<article") : page.index("</article")]
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", article)).split())


def test_every_link_of_every_page_leads_to_a_file_and_a_heading(site):
    pages = pages_of(site)
    ids = {path: set(re.findall(r'\bid="([^"]+)"', page)) for path, page in pages.items()}
    checked = 0
    for path, page in pages.items():
        if path.name == "404.html":  # for a server: its links begin at the site's address
            continue
        for link in re.findall(r'(?:href|src)="?([^">\s]+)', page):
            target, _, anchor = html.unescape(link).partition("#")
            if re.match(r"[a-z]+:", target):
                continue
            there = (path.parent / unquote(target)).resolve() if target else path
            assert there.is_file(), f"{path}: {link}"
            assert not anchor or there not in ids or unquote(anchor) in ids[there], (
                f"{path}: {link}"
            )
            checked += 1
    assert checked > 1000


def test_a_reader_of_the_site_fetches_nothing_from_elsewhere(site):
    loads = re.compile(r'<(?:script|img|iframe)[^>]*\bsrc="?(https?:[^">\s]+)')
    sheets = re.compile(r'<link[^>]*\bhref="?(https?:[^">\s]+)')
    for path, page in pages_of(site).items():
        assert loads.findall(page) + sheets.findall(page) == [], path
        assert "fonts.g" not in page


def test_the_reference_has_what_users_import_and_no_more(site):
    parts = {f"sb3_sparse.{door}".rstrip(".") for door in DOORS}
    assert {path.stem for path in (site / "reference").glob("*.html")} == parts
    page = (site / "reference" / "sb3_sparse.topology.html").read_text()
    for name in topology.__all__:
        assert f'id="sb3_sparse.topology.{name}"' in page or f'.{name}"' in page


def test_examples_of_docstrings_are_shown_as_code(site):
    page = (site / "reference" / "sb3_sparse.html").read_text()
    shown = [
        html.unescape(re.sub(r"<[^>]+>", "", code))
        for code in re.findall(r"<code>(.*?)</code>", page, re.S)
    ]
    assert any(
        'SparsityCallback("rigl", update_interval=10)' in code and "learn(40" in code
        for code in shown
    )
    for path in (site / "reference").glob("*.html"):
        said = words_of(path.read_text())
        assert "::" not in said, path
        assert not re.search(r":(param|return|raises|class|func|meth)\b", said), path


def test_files_of_the_repository_that_pages_link_to_are_pages(site):
    assert "board" in words_of(
        (site / "repository/examples/microcontroller/index.html").read_text()
    )
    code = (site / "repository/examples/tour.py.html").read_text()
    assert "evaluate_policy" in words_of(code)
    joining = words_of((site / "repository/CONTRIBUTING.html").read_text())
    assert " 2. " not in joining  # all are items of lists
    changes = (site / "repository/CHANGELOG.html").read_text()
    assert 'href="../simba.html"' in changes


def test_every_document_is_in_the_navigation():
    # SafeLoader has no constructor for what Python adds to YAML, and mkdocs.yml needs none.
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    named = set(hook("pages").navigation(nav))
    assert {path.name for path in (ROOT / "docs").glob("*.md")} <= named


@pytest.mark.parametrize(
    ("path", "uri"),
    [
        ("docs/configs.md", "configs.md"),
        ("CHANGELOG.md", "repository/CHANGELOG.md"),
        ("examples/tune.py", "repository/examples/tune.py.md"),
        ("examples", "repository/examples/index.md"),
    ],
)
def test_a_file_has_one_page_and_a_page_one_file(path, uri):
    pages = hook("pages")
    assert pages.site_uri(path) == uri
    assert pages.source(uri) == path
    assert pages.site_uri("examples/microcontroller") == pages.site_uri(
        "examples/microcontroller/README.md"
    )


def test_what_belongs_to_a_numbered_item_stays_in_it():
    text = "1. One\n   line:\n\n   ```\n   a\n       b\n   ```\n2. Two\n\n- a\n  b\n"
    lines = hook("pages").deeper(text).splitlines()
    assert lines[1:7] == ["    line:", "", "    ```", "    a", "        b", "    ```"]
    assert lines[7:] == ["", "2. Two", "", "- a", "  b"]


def test_docstrings_become_markdown():
    text = """Return the :class:`~sb3_sparse.zoo.RunSpec` of ``path``.

Example::

    run = spec_of("a")

    print(run)

:param path: a file, or
    a folder
:raises ConfigError: if it is neither

Source: a paper. In short:

>>> 1 + 1
2
"""
    assert (
        hook("docstrings").markdown(text)
        == """Return the `RunSpec` of ``path``.

Example:

```python
run = spec_of("a")

print(run)
```

Source: a paper. In short:

```pycon
>>> 1 + 1
2
```

:param path: a file, or
    a folder
:raises ConfigError: if it is neither"""
    )
