"""Which algorithm saved a zip, by what the zip holds."""

from __future__ import annotations

from pathlib import Path

from sb3_sparse.errors import ConfigError, MissingExtra
from sb3_sparse.loading.sbx import is_sbx, sbx_algorithms
from sb3_sparse.loading.zips import read_model
from sb3_sparse.policies.registry import possible_algorithms
from sb3_sparse.zoo.spec import algorithms


def algos_of(path: Path) -> list[str]:
    """Return the algorithms that may have saved a zip, by its policy and attributes.

    There are several where they share a policy class, as TD3 and DDPG do; the first is the
    likeliest.

    :raises ConfigError: if the zip is not a model, or of an unsupported algorithm
    :raises MissingExtra: if SBX saved it, with an algorithm whose SB3 counterpart is not installed
    """
    if is_sbx(path):
        found = sbx_algorithms(path)
        if found[0] not in algorithms():
            raise MissingExtra(f"a model of SBX's {found[0].upper()}", "contrib")
        return found
    data, _ = read_model(path)
    policy = data.get("policy_class")
    found = possible_algorithms(policy, data) if isinstance(policy, type) else []
    if not found:
        named = policy.__name__ if isinstance(policy, type) else repr(policy)
        raise ConfigError(
            f"{path} has the policy {named}, which belongs to no supported algorithm; allowed are "
            f"{', '.join(algorithms())}"
        )
    return [name.lower() for name in found]


def algo_of(path: Path, given: str | None, known: str | None) -> str:
    """Return the algorithm to load a zip with.

    :param path: the zip
    :param given: what the user names; None: nothing
    :param known: what the zip's run names; None: it has no run
    :raises ConfigError: if the given one is unknown, or not the file's
    """
    if given is None:
        return known or algos_of(path)[0]
    if given not in algorithms():
        raise ConfigError(f"unknown algorithm {given!r}; allowed are {', '.join(algorithms())}")
    told = algos_of(path)
    if given not in told:
        raise ConfigError(f"{path} is a model of {told[0]}, not of {given}; leave --algo out")
    return given
