"""Keyword arguments: which names a class takes, and classes given by their dotted path."""

from __future__ import annotations

import inspect
from functools import cache
from importlib import import_module
from typing import Any

from sb3_sparse.errors import ConfigError

CLASSES = ("features_extractor_class", "optimizer_class", "activation_fn")


def import_path(path: str) -> Any:
    """Import the object at a dotted path.

    :raises ImportError: if there is none
    """
    module, _, name = path.rpartition(".")
    try:
        return getattr(import_module(module), name)
    except (AttributeError, ValueError) as error:
        raise ImportError(str(error)) from error


def import_classes(kwargs: dict[str, Any]) -> None:
    """Replace dotted paths of classes (``"torch.nn.Tanh"``) by the classes, in place.

    :param kwargs: SB3's policy arguments
    :raises ConfigError: if there is no such class
    """
    for argument in CLASSES:
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


@cache
def arguments_of(cls: type, start: type | None = None) -> frozenset[str]:
    """Names of a class's keyword arguments, without those that every SB3 class is given.

    A constructor with ``**kwargs`` takes the arguments of its base class, too.

    :param start: the base class whose constructor gets the arguments; None: ``cls`` itself
    """
    names: set[str] = set()
    for base in cls.__mro__[cls.__mro__.index(start or cls) :]:
        if "__init__" not in vars(base):
            continue
        parameters = inspect.signature(vars(base)["__init__"]).parameters
        names.update(parameters)
        if not any(one.kind is one.VAR_KEYWORD for one in parameters.values()):
            break
    given = "self args kwargs env observation_space action_space lr_schedule _init_setup_model"
    return frozenset(names - {*given.split()})
