"""Reads the YAML files of rl-zoo's run folders without running code from them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_sparse.errors import CorruptStateError, MissingExtra
from sb3_sparse.loading.guard import reading
from sb3_sparse.loading.text import read_text

try:
    import yaml
except ImportError as error:
    raise MissingExtra("reading a run", "zoo") from error

PYTHON = "tag:yaml.org,2002:python/"


@dataclass(frozen=True)
class NotBuilt:
    """Stands for a Python object that a file asks for.

    :param tag: the file's tag for it, e.g. ``"object/apply:os.system"``
    """

    tag: str


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """Knows rl-zoo's harmless tags; every other Python object becomes a :class:`NotBuilt`."""

    def ordered(self, node: Any) -> dict[Any, Any]:
        """Read an OrderedDict, written as a call with one list of pairs."""
        (pairs,) = self.construct_sequence(node, deep=True)
        return dict(pairs)

    def tuple_(self, node: Any) -> tuple[Any, ...]:
        """Read a tuple."""
        return tuple(self.construct_sequence(node, deep=True))

    def name(self, suffix: str, node: Any) -> str:
        """Read a class or function as its dotted path."""
        return suffix

    def other(self, suffix: str, node: Any) -> NotBuilt:
        """Read anything else."""
        return NotBuilt(suffix)


_Loader.add_constructor(f"{PYTHON}object/apply:collections.OrderedDict", _Loader.ordered)
_Loader.add_constructor(f"{PYTHON}tuple", _Loader.tuple_)
_Loader.add_multi_constructor(f"{PYTHON}name:", _Loader.name)
_Loader.add_multi_constructor(PYTHON, _Loader.other)


def read_zoo_yaml(path: Path, cure: str) -> dict[str, Any]:
    """Read the mapping in ``args.yml`` or ``config.yml`` of a run.

    :param cure: what to do if the file cannot be read
    :raises ConfigError: if the file cannot be opened
    :raises CorruptStateError: if the file holds something else
    """
    what = "YAML file of a run"
    text = read_text(path, what, cure)
    with reading(path, what, cure):
        content = yaml.load(text, Loader=_Loader)
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise CorruptStateError(
            f"{path} is damaged, or holds no {what}: it does not map names to values; {cure}"
        )
    return content


def check_built(value: Any, where: str) -> None:
    """Reject a value that contains a :class:`NotBuilt`.

    :param where: the value's name in the error
    :raises CorruptStateError: if it contains one
    """
    parts: list[Any] = [value]
    while parts:
        part = parts.pop()
        if isinstance(part, NotBuilt):
            raise CorruptStateError(
                f"{where} asks for the Python object {part.tag!r}, which is not built, since files "
                "are read without running code; write a plain value there"
            )
        if isinstance(part, dict):
            parts += [*part.keys(), *part.values()]
        elif isinstance(part, (list, tuple)):
            parts += part
