"""Search spaces, by name or from a user's file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sb3_sparse.errors import ConfigError
from sb3_sparse.loading.text import read_text
from sb3_sparse.sparsity.numeric import is_number, is_whole
from sb3_sparse.tuning.backend import BaseDistribution, quiet_optuna
from sb3_sparse.tuning.choices import check_space_name
from sb3_sparse.tuning.shipped import paper_space, wide_space
from sb3_sparse.tuning.spaces import (
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
    Space,
    run_code,
)
from sb3_sparse.zoo.configs import read_yaml
from sb3_sparse.zoo.match import untrained_policy
from sb3_sparse.zoo.prepare import prepare
from sb3_sparse.zoo.spec import RunSpec


@quiet_optuna()
def space_of(what: str, run: RunSpec) -> Space:
    """Return a shipped space for a run, or a space of your own from a file.

    A YAML file maps names to lists of choices or to ``{low: .., high: .., log: true, step: ..}``. A
    Python file defines ``space``: such a mapping, or a function of an Optuna trial that returns the
    values by name.

    :param what: ``"paper"``, ``"wide"`` or a path
    :param run: what is to be tuned
    :raises ConfigError: if there is no such space, or if it is not valid
    """
    check_space_name(what)
    if what in SHIPPED:
        return SHIPPED[what](run)
    path = Path(what)
    if path.suffix in (".yml", ".yaml"):
        content = read_yaml(path, "hyperparameters to choices")
        return Space(path.stem, _distributions(content, path.name))
    code = read_text(path, "search space", "give a file of your own (docs/tuning.md)")
    found = run_code(code, path.name)
    if isinstance(found, Mapping):
        return Space(path.stem, _distributions(found, path.name))
    return Space(path.stem, code=code)


def _paper(run: RunSpec) -> Space:
    return paper_space(run.settings().method)


def _wide(run: RunSpec) -> Space:
    prepared = prepare(run, Path("logs"))
    policy = untrained_policy(
        run.algorithm, prepared.observation_space, prepared.action_space, prepared.settings
    )
    sizes = {network.name: network.size for network in policy.sparse.networks}
    sparsity = policy.sparsity_config.sparsity
    shared = sparsity if isinstance(sparsity, float) else None
    return wide_space(run.settings().method, sizes, shared)


SHIPPED: dict[str, Callable[[RunSpec], Space]] = {"paper": _paper, "wide": _wide}


def _distributions(content: Mapping[str, Any], name: str) -> dict[str, BaseDistribution]:
    return {str(key): _distribution(str(key), value, name) for key, value in content.items()}


def _distribution(key: str, value: Any, name: str) -> BaseDistribution:
    if isinstance(value, BaseDistribution):
        return value
    try:
        if isinstance(value, (list, tuple)):
            return CategoricalDistribution(value)
        if isinstance(value, Mapping) and _is_range(value):
            whole = all(is_whole(value[end]) for end in ("low", "high"))
            return IntDistribution(**value) if whole else FloatDistribution(**value)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{key} in {name}: {error}") from error
    raise ConfigError(
        f"{key} in {name} must be a list of choices, or a range {{low: 0.1, high: 0.5}} of "
        "numbers, to which log: true or step: 0.1 may be added (YAML reads 1e-6 as text; write "
        f"1.0e-6), got {value!r}"
    )


def _is_range(value: Mapping[str, Any]) -> bool:
    ends = [value.get(end) for end in ("low", "high")]
    numbers = all(is_number(end) for end in ends)
    return numbers and value.keys() <= {"low", "high", "log", "step"}
