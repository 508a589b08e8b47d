"""YAML as PyYAML reads it, except that a repeated key in a mapping is rejected."""

from __future__ import annotations

import json
from collections.abc import Hashable
from typing import Any

from sb3_sparse.errors import ConfigError, MissingExtra

try:
    import yaml
except ImportError as error:
    raise MissingExtra("reading configs", "zoo") from error


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """Rejects repeated keys, of which PyYAML silently keeps the last."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        # flatten_mapping expands a merge (<<), where own keys rightly win: check before it does.
        if isinstance(node, yaml.MappingNode) and not hasattr(node, "checked"):
            self._check(node)
        return super().construct_mapping(node, deep)

    def flatten_mapping(self, node: Any) -> None:
        if not hasattr(node, "checked"):
            self._check(node)
        super().flatten_mapping(node)

    def _check(self, node: Any) -> None:
        node.checked = True  # an anchored mapping is flattened again at each of its aliases
        first: dict[Any, int] = {}
        for key_node, _ in node.value:
            key = "<<" if key_node.tag.endswith(":merge") else self.construct_object(key_node)
            if not isinstance(key, Hashable):
                continue  # PyYAML rejects it
            line = key_node.start_mark.line + 1
            if key in first:
                cure = "give a list, <<: [*a, *b]" if key == "<<" else "keep one"
                raise ConfigError(
                    f"the key {key!r} is in line {first[key]} and again in line {line}; {cure}"
                )
            first[key] = line


def parse(text: str) -> Any:
    """Parse a YAML text.

    :raises ConfigError: if it is invalid, repeats a key in a mapping, or an alias holds itself
    """
    try:
        content = yaml.load(text, Loader=_Loader)
        json.dumps(content, skipkeys=True, default=str)  # visits everything
    except yaml.YAMLError as error:
        raise ConfigError(" ".join(str(error).split())) from error
    except (ValueError, RecursionError) as error:  # !!float x, 2024-99-99, an alias in itself
        raise ConfigError(f"{error}") from error
    return content
