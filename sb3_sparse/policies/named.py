"""Classes named by their dotted path, so that a policy's arguments can be plain JSON or YAML."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from sb3_sparse.errors import ConfigError

ARGUMENTS = ("features_extractor_class", "optimizer_class", "activation_fn")


def import_path(path: str) -> Any:
    """What a dotted path names.

    :raises ImportError: if there is no such thing
    """
    module, _, name = path.rpartition(".")
    try:
        return getattr(import_module(module), name)
    except (AttributeError, ValueError) as error:
        raise ImportError(str(error)) from error


def import_named(kwargs: dict[str, Any]) -> None:
    """Replace, in place, the path of a class (``"torch.nn.Tanh"``) by the class itself.

    :param kwargs: SB3's policy arguments
    :raises ConfigError: if there is no such class
    """
    for argument in ARGUMENTS:
        path = kwargs.get(argument)
        if not isinstance(path, str):
            continue
        try:
            kwargs[argument] = import_path(path)
        except ImportError as error:
            raise ConfigError(
                f"{argument}={path!r} cannot be imported ({error}); give a class or its dotted "
                "path, e.g. 'torch.nn.ReLU'"
            ) from error
