"""Settings as YAML: written as PyYAML reads it, or merged into one entry of a file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import yaml

from sb3_sparse.errors import ConfigError, MissingExtra

try:
    from ruamel.yaml import YAML
    from ruamel.yaml.comments import CommentedMap
    from ruamel.yaml.error import YAMLError
except ImportError as error:
    raise MissingExtra("tuning", "tune") from error

INDENT = 2


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]
    """A dumper that indents lists below their key, and writes lists of plain values in one line."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> Any:
        return super().increase_indent(flow, False)

    def represent_items(self, items: list[Any] | tuple[Any, ...]) -> yaml.Node:
        nested = any(isinstance(item, (Mapping, list, tuple)) for item in items)
        return self.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=not nested)


_Dumper.add_representer(list, _Dumper.represent_items)
_Dumper.add_representer(tuple, _Dumper.represent_items)


def as_yaml(content: Mapping[str, Any]) -> str:
    """Write a mapping of plain values as block YAML, as rl-zoo (PyYAML) reads it."""
    text = yaml.dump(dict(content), Dumper=_Dumper, sort_keys=False, width=4096, allow_unicode=True)
    assert isinstance(text, str)
    return text


def merge_entry(
    text: str, key: str, settings: Mapping[str, Any], comment: str, mark: str, name: str
) -> str:
    """Give one top-level entry of a YAML text new settings, and leave everything else as it is.

    :param key: key of the entry; a missing one is added at the end, based on ``default``
    :param comment: a line for the entry, which replaces a line that begins with ``mark``
    :param name: name of the file, for messages
    :return: the new text
    :raises ConfigError: if other entries would change too, or if the text cannot be parsed
    """
    ending = "\r\n" if "\r\n" in text else "\n"
    lines = text.splitlines()
    by_hand = f"the entry {key} in {name} cannot be changed line by line"
    cure = "take the tuned settings from best.yml by hand"
    try:
        document = YAML().load(text)
        if key in document:
            entry = document[key]
            shared = any(document[other] is entry for other in document if other != key)
            if shared or not isinstance(entry, CommentedMap) or entry.fa.flow_style():
                raise ConfigError(f"{by_hand}, since it is not a block of its own; {cure}")
            _Entry(lines, document, key).change(settings, comment, mark)
        else:
            lines += ["", *_new_entry(document, key, settings, comment)]
        changed = ending.join(lines) + ending
        before, after = yaml.safe_load(text), yaml.safe_load(changed)
    except (yaml.YAMLError, YAMLError) as error:
        raise ConfigError(f"{by_hand} ({str(error).splitlines()[0]}); {cure}") from error
    others = [k for k in before if k != key and before[k] != after.get(k)]
    if others:
        raise ConfigError(
            f"{', '.join(others)} in {name} take their values from {key}, and would change with "
            f"it; give {key} an entry of its own first"
        )
    if after[key] != dict(settings):
        differ = {k for k in {*after[key], *settings} if after[key].get(k) != settings.get(k)}
        kept = ", ".join(sorted(differ))
        raise ConfigError(f"{by_hand} to the tuned settings (it would differ in {kept}); {cure}")
    return changed


def _new_entry(
    document: CommentedMap, key: str, settings: Mapping[str, Any], comment: str
) -> list[str]:
    default = document.get("default")
    anchor = None if default is None else default.anchor.value
    known = dict(default) if anchor else {}
    own = {name: value for name, value in settings.items() if known.get(name) != value}
    block = as_yaml({key: own}).splitlines() if own else [f"{key}:"]
    inside = [f"  # {comment}", *([f"  <<: *{anchor}"] if anchor else [])]
    return [block[0], *inside, *block[1:]]


class _Entry:
    """One entry of a YAML text, whose lines are changed in place.

    :param lines: the whole text
    :param document: the text as ruamel.yaml read it
    :param key: key of the entry
    """

    def __init__(self, lines: list[str], document: CommentedMap, key: str) -> None:
        self.lines, self.document, self.key = lines, document, key

    def change(self, settings: Mapping[str, Any], comment: str, mark: str) -> None:
        """Give the entry the settings and the comment."""
        start = self.document.lc.key(self.key)[0]
        end = self._end(start)
        edits = self._edits(self.document[self.key], settings, end)
        for first, last, new in sorted(edits, key=lambda edit: edit[0], reverse=True):
            self.lines[first:last] = new
        if self.lines[start + 1].lstrip("# ").startswith(mark):
            del self.lines[start + 1]
        self.lines.insert(start + 1, f"{' ' * INDENT}# {comment}")

    def _edits(
        self, known: CommentedMap, wanted: Mapping[str, Any], end: int
    ) -> list[tuple[int, int, list[str]]]:
        """Return the lines to replace in a block mapping: first, last + 1 and the new ones."""
        own = [name for name in known if name in (known.lc.data or {})]
        column = min((known.lc.key(name)[1] for name in own), default=INDENT)
        edits, added = [], []
        for name, value in wanted.items():
            if name in known and known[name] == value:
                continue
            if name not in own:
                added += self._dumped(name, value, column)
                continue
            first = known.lc.key(name)[0]
            last, old = self._end(first), known[name]
            block = isinstance(old, CommentedMap) and last > first + 1
            if block and isinstance(value, Mapping) and set(old) <= set(value):
                edits += self._edits(old, value, last)
            else:
                new = self._dumped(name, value, column)
                if last == first + 1 and isinstance(old, (bool, int, float)):
                    comment = re.search(r"\s+#.*$", self.lines[first])
                    new[0] += comment.group() if comment else ""
                edits.append((first, last, new))
        if added:
            edits.append((end, end, added))
        return edits

    def _end(self, first: int) -> int:
        """Return the line after the block of the key at a line."""
        column = _indent(self.lines[first])
        last = first
        for number in range(first + 1, len(self.lines)):
            line = self.lines[number].strip()
            if not line or line.startswith("#"):
                continue
            here = _indent(self.lines[number])
            if here < column or (here == column and not line.startswith("- ")):
                break
            last = number
        return last + 1

    @staticmethod
    def _dumped(name: str, value: Any, column: int) -> list[str]:
        return [" " * column + line for line in as_yaml({name: value}).splitlines()]


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip(" "))
