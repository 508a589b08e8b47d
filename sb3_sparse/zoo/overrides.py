"""Reads ``name:value``, the form of rl-zoo's ``--hyperparams``."""

from __future__ import annotations

import ast
from collections.abc import Iterable
from typing import Any

from sb3_sparse.errors import ConfigError


def parse_overrides(texts: Iterable[str]) -> dict[str, Any]:
    """Parse ``["learning_rate:0.001", ...]``, the form of rl-zoo's ``--hyperparams``.

    A value is a Python literal or ``dict(...)`` of literals; anything else (``lin_0.001``, a
    dotted path) is text.

    :raises ConfigError: for a text without a colon
    """
    overrides: dict[str, Any] = {}
    for text in texts:
        name, colon, value = text.partition(":")
        if not colon or not name or not value:
            raise ConfigError(
                f"hyperparameters are given as name:value, e.g. learning_rate:0.001, got {text!r}"
            )
        overrides[name] = literal(value)
    return overrides


class _DictCalls(ast.NodeTransformer):
    """Turns ``dict(a=1)``, as the zoo's files write it, into ``{"a": 1}``."""

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        if not (isinstance(node.func, ast.Name) and node.func.id == "dict") or node.args:
            return node
        keys: list[ast.expr | None] = [ast.Constant(keyword.arg) for keyword in node.keywords]
        return ast.Dict(keys=keys, values=[keyword.value for keyword in node.keywords])


def literal(text: str) -> Any:
    """Return the literal that a text holds; the text itself if it holds none."""
    try:
        return ast.literal_eval(_DictCalls().visit(ast.parse(text.strip(), mode="eval")))
    except (ValueError, SyntaxError):
        return text
