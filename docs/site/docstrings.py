"""The package's docstrings, whose markup is reStructuredText as in SB3, as Markdown."""

from __future__ import annotations

import re
import textwrap
from typing import Any

import griffe

ROLE = re.compile(r":(?:class|meth|func|attr|data|mod):`~?([^`]+)`")
FIELD = re.compile(r":\w[^:`]*:(?: |$)")


class Markdown(griffe.Extension):
    """Rewrites each docstring before it is parsed."""

    def on_instance(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Rewrite the docstring of a module, class, function or attribute."""
        if obj.docstring:
            obj.docstring.value = markdown(obj.docstring.value)


def markdown(text: str) -> str:
    """A docstring as Markdown: code in fences, roles as code, and fields, which end it, last."""
    prose, fields = divided(ROLE.sub(lambda role: f"`{role[1].rsplit('.')[-1]}`", text))
    return "\n".join([*fenced(prose), "", *fields]).strip()


def divided(text: str) -> tuple[list[str], list[str]]:
    """The lines of a docstring that are prose, and those of its fields (``:param x: ...``)."""
    prose: list[str] = []
    fields: list[str] = []
    lines = prose
    for line in text.splitlines():
        if FIELD.match(line):
            lines = fields
        elif not line.strip():
            prose.append("")
            lines = prose
            continue
        lines.append(line)
    return prose, fields


def fenced(lines: list[str]) -> list[str]:
    """The same, with blocks of code in fences."""
    text = "\n".join(lines)
    text = re.sub(r"::\n\n((?: +[^\n]*\n|\n)+?)(?=\S|\Z)", block, text + "\n")
    text = re.sub(
        r"^((?:>>> [^\n]*\n(?:[^\n]+\n)*)+)", r"```pycon\n\1```\n", text, flags=re.MULTILINE
    )
    return text.splitlines()


def block(found: re.Match[str]) -> str:
    """A fence in place of an indented block."""
    code = textwrap.dedent(found[1]).strip()
    return f":\n\n```python\n{code}\n```\n\n"
