"""What a policy class declares of its networks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_sparse.engine.prunable import Prunable

DENSE_WORDS = ("input", "output")


@dataclass(frozen=True)
class NetworkSpec:
    """One network of a policy, by dotted names of modules (``fnmatch`` patterns match several).

    Example::

        from sb3_sparse import SparseDQNPolicy

        spec = SparseDQNPolicy.networks["q_net"]
        assert (spec.roots, spec.target) == (("q_net",), "q_net_target")

    :param roots: modules whose layers belong to the network; a layer that an earlier network has,
        such as one of a shared features extractor, stays with that one
    :param trunks: modules whose first layer reads features
    :param heads: modules whose last layer is an output
    :param target: copy of the root in the target network; None: there is no target network
    :param owner: module whose ``optimizer`` trains the network; empty: the policy
    """

    roots: tuple[str, ...]
    trunks: tuple[str, ...]
    heads: tuple[str, ...]
    target: str | None = None
    owner: str = ""


@dataclass(frozen=True)
class PassCounts:
    """How often a gradient step runs one network, on average, for each sample of the minibatch.

    Example::

        from sb3_sparse import PassCounts

        double_dqn = [PassCounts("q_net", forward=2, backward=1), PassCounts("q_net", target=True)]

    :param network: name of the network
    :param forward: forward passes
    :param backward: backward passes that give the gradient of its weights; each costs 2 forward
    :param through: backward passes that only compute the gradient of its actions; each costs 1
        forward, without the features extractor
    :param target: whether it is the target network that runs
    :param leaves_out: name pattern of layers that do not run
    :param shares: whether layers that another network shares run again for this one
    """

    network: str
    forward: float = 1.0
    backward: float = 0.0
    through: float = 0.0
    target: bool = False
    leaves_out: str = ""
    shares: bool = True


def in_target(name: str, specs: Mapping[str, NetworkSpec]) -> bool:
    """Whether a dotted name lies in a target network."""
    targets = (f"{spec.target}." for spec in specs.values() if spec.target is not None)
    return name.startswith(tuple(targets))


@dataclass
class NetworkLayers:
    """The layers of one network: those within the budget, and those left dense."""

    sparse: list[tuple[str, Prunable]] = field(default_factory=list)
    dense: list[tuple[str, Prunable]] = field(default_factory=list)


def _by_module(names: Sequence[str], patterns: Sequence[str]) -> Iterator[list[str]]:
    """Layer names, grouped by the module around them that a pattern matches."""
    for pattern in patterns:
        depth = pattern.count(".") + 1
        groups: dict[str, list[str]] = {}
        for name in names:
            module = ".".join(name.split(".")[:depth])
            if fnmatchcase(module, pattern):
                groups.setdefault(module, []).append(name)
        yield from groups.values()


def input_layers(policy: nn.Module, spec: NetworkSpec, names: Sequence[str]) -> set[str]:
    """The first layer of each features extractor; if there is none, of each trunk.

    :param names: layer names of the network, in module order
    """
    found: set[str] = set()
    in_extractor: set[str] = set()
    reads_raw = False
    seen: set[int] = set()
    for root in spec.roots:
        if root not in dict(policy.named_modules(remove_duplicate=False)):
            continue
        for path, module in policy.get_submodule(root).named_modules(prefix=root):
            if not isinstance(module, BaseFeaturesExtractor) or id(module) in seen:
                continue
            seen.add(id(module))
            nested = [m for m in module.modules() if isinstance(m, BaseFeaturesExtractor)]
            layers = [name for name in names if name.startswith(f"{path}.")]
            in_extractor.update(layers)
            if len(nested) > 1:  # a CombinedExtractor, with one extractor for each image
                reads_raw |= any(isinstance(m, nn.Flatten) for m in _values(module))
            elif layers:
                found.add(layers[0])
    if not in_extractor or reads_raw:
        rest = [name for name in names if name not in in_extractor]
        trunks = list(_by_module(rest, spec.trunks)) or list(_by_module(rest, spec.heads))
        found.update(group[0] for group in trunks)
    return found


def _values(extractor: nn.Module) -> Iterator[nn.Module]:
    for child in extractor.children():
        if isinstance(child, nn.ModuleDict):
            yield from child.values()


def output_layers(spec: NetworkSpec, names: Sequence[str]) -> set[str]:
    """The last layer of each head."""
    return {group[-1] for group in _by_module(names, spec.heads)}


def matches(name: str, patterns: Sequence[str]) -> bool:
    """Whether a layer's dotted name, or a module around it, matches one of the patterns."""
    return any(
        fnmatchcase(name, pattern) or fnmatchcase(name, f"{pattern}.*")
        for pattern in patterns
        if pattern not in DENSE_WORDS
    )
