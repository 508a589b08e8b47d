"""What a saved model's attributes must be for it to be trained further."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_sparse.errors import CorruptStateError
from sb3_sparse.policies.internals import COUNTERS
from sb3_sparse.sparsity.numeric import is_whole
from sb3_sparse.zoo.arguments import Kind, kind_of

COUNTED = ("num_timesteps", *COUNTERS)
WHOLE = Kind("a whole number, 0 or more", lambda v: is_whole(v) and v >= 0)


def check_attributes(path: Path, algo: str, data: Mapping[str, Any]) -> None:
    """Reject a model with a setting that it cannot be trained with.

    :param path: the model's zip
    :param algo: algorithm, e.g. ``"sac"``
    :param data: the model's attributes; only plain values are checked
    :raises CorruptStateError: naming the setting and what it may be
    """
    for name, value in data.items():
        kind = WHOLE if name in COUNTED else kind_of(algo, name)
        plain = value is None or isinstance(value, (bool, int, float, str, list, dict))
        if kind is not None and plain and not kind.fits(value):
            raise CorruptStateError(
                f"{path} cannot be trained further: {name} must be {kind.allowed}, got {value!r}. "
                "Load it, correct that and save it again, or use an earlier model"
            )
    episodes = {type(data.get(name)) for name in ("ep_info_buffer", "ep_success_buffer")}
    if episodes not in ({deque}, {type(None)}):
        raise CorruptStateError(
            f"{path} is damaged: a buffer of episodes is missing or of another type; use an "
            "earlier model"
        )
