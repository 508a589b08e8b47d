"""Pages of the site that are no files of docs/: files of the repository, and the reference.

Documents link to each other and to files of the repository as files do, so their links work on a
forge. On the site, a file outside docs/ that a page links to is a page below repository/.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
DOCS = "docs/"
REPOSITORY = "repository/"
LANGUAGES = {
    ".py": "python",
    ".c": "c",
    ".h": "c",
    ".ino": "cpp",
    ".yml": "yaml",
    ".md": "markdown",
    ".ld": "text",
    "LICENSE": "text",
    "Makefile": "makefile",
    "Kbuild": "makefile",
    "app-config": "text",
}
LINK = re.compile(r"(\]\()([^)#\s]+)(#[^)\s]*)?(\))")
FENCE = re.compile(r"^ *(```|~~~).*?^ *\1[^\n]*$", re.MULTILINE | re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made here: those of the navigation, and what pages link to."""
    named = [uri for uri in navigation(config.nav) if files.get_file_from_path(uri) is None]
    waiting = [uri.removeprefix(REPOSITORY) for uri in named if uri.startswith(REPOSITORY)]
    for page in files.documentation_pages():
        waiting += outside(DOCS + page.src_uri)
    while waiting:
        path = waiting.pop()
        uri = site_uri(path)
        if (ROOT / path).exists() and files.get_file_from_path(uri) is None:
            files.append(File.generated(config, uri, content=shown(path)))
            waiting += outside(path)
    for uri in named:
        if found := re.fullmatch(r"reference/(.*)\.md", uri):
            files.append(File.generated(config, uri, content=reference(found[1])))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links to files of the repository into links to their pages."""
    here = page.file.src_uri
    path = source(here)

    def moved(link: re.Match[str]) -> str:
        before, target, anchor, after = link.groups("")
        if ":" in target:
            return link[0]
        there = site_uri(resolved(path, target))
        return before + posixpath.relpath(there, posixpath.dirname(here)) + anchor + after

    return deeper(outside_of_code(markdown, moved))


def outside_of_code(markdown: str, change: Callable[[re.Match[str]], str]) -> str:
    """Markdown whose links are changed, but not what looks like links in blocks of code."""
    parts, end = [], 0
    for block in FENCE.finditer(markdown):
        parts += [LINK.sub(change, markdown[end : block.start()]), block[0]]
        end = block.end()
    return "".join([*parts, LINK.sub(change, markdown[end:])])


def deeper(markdown: str) -> str:
    """Markdown whose numbered lists indent by four, as the site reads them: a forge takes three.

    Nor does the site see an item that follows the paragraph of another without an empty line.
    """
    lines: list[str] = []
    inside = False
    for line in markdown.splitlines():
        if line and not line.startswith(" "):
            item = re.match(r"\d+\. ", line) is not None
            if inside and item and lines[-1].startswith(" "):
                lines.append("")
            inside = item
        lines.append(" " + line if inside and line.startswith("   ") else line)
    return "\n".join(lines)


def resolved(path: str, target: str) -> str:
    """The file of the repository that a link in another means.

    :param path: the file, or folder, that has the link
    :param target: the link, without its anchor
    """
    folder = path if (ROOT / path).is_dir() else posixpath.dirname(path)
    return posixpath.normpath(posixpath.join(folder, target))


def site_uri(path: str) -> str:
    """Where a file or folder of the repository is on the site, as a path in docs/."""
    if path.startswith(DOCS):
        return path.removeprefix(DOCS)
    if (ROOT / path).is_dir():
        readme = f"{path}/README.md"
        return REPOSITORY + (readme if (ROOT / readme).exists() else f"{path}/index.md")
    return REPOSITORY + (path if path.endswith(".md") else f"{path}.md")


def source(uri: str) -> str:
    """The file or folder of the repository that a page shows: the inverse of :func:`site_uri`."""
    if not uri.startswith(REPOSITORY):
        return DOCS + uri
    path = uri.removeprefix(REPOSITORY)
    if (ROOT / path).exists():
        return path
    return path.removesuffix("/index.md") if path.endswith("/index.md") else path[:-3]


def outside(path: str) -> Iterator[str]:
    """Files and folders outside docs/ that a page links to, by their paths in the repository."""
    if path.endswith(".md") or (ROOT / path).is_dir():
        for _, target, _, _ in LINK.findall(FENCE.sub("", shown(path))):
            there = resolved(path, target)
            if ":" not in target and not there.startswith(DOCS):
                yield there


def shown(path: str) -> str:
    """The Markdown that shows a file or folder of the repository."""
    place = ROOT / path
    if place.is_dir():
        names = sorted(
            one.relative_to(place).as_posix()
            for one in place.rglob("*")
            if one.is_file() and language(one) and "/build-" not in str(one)
        )
        return "\n".join([f"# {path}\n", *(f"- [{name}]({name})" for name in names)])
    text = place.read_text(encoding="utf-8")
    if path.endswith(".md"):
        return text
    return f"# {path}\n\n~~~~~~{language(place) or 'text'}\n{text}\n~~~~~~\n"


def language(place: Path) -> str | None:
    """What a file is highlighted as; None for what is not text."""
    return LANGUAGES.get(place.suffix or place.name)


@cache
def package() -> griffe.Module:
    """The package as its source says, without importing it."""
    found = griffe.load("sb3_sparse", search_paths=[ROOT], allow_inspection=False)
    assert isinstance(found, griffe.Module)
    return found


def reference(part: str) -> str:
    """A page of the reference: what a part is for, and all that stands in its ``__all__``.

    :param part: a public package, ``"sb3_sparse.zoo"``
    """
    module = package() if part == "sb3_sparse" else package()[part.removeprefix("sb3_sparse.")]
    names = sorted(map(str, module.exports), key=str.lower)
    options = "{members: false, show_root_heading: false, show_root_toc_entry: false}"
    about = f"::: {part}\n    options: {options}\n"
    entries = "\n".join(f"::: {part}.{name}\n" for name in names)
    return f"# {part}\n\n{about}\n{entries}"


def navigation(entry: Any) -> Iterator[str]:
    """Every page of a navigation, or of a part of it."""
    if isinstance(entry, str):
        yield entry
    else:
        for part in entry.values() if isinstance(entry, dict) else entry:
            yield from navigation(part)
