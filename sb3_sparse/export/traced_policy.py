"""What tracing the actions of a policy has found, which further outputs go on from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import nn

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export.trace import Tracer
from sb3_sparse.policies.base import BaseSparsePolicy


@dataclass(frozen=True)
class TracedPolicy:
    """A policy whose actions are traced.

    :param policy: sparse or stock
    :param declared: the class that declares where the policy keeps its networks
    :param tracer: collects the operations
    :param observation: input of the features extractors, or one for each key of a dict
    :param features: result of the actor's features extractor
    :param latent: what the last of the acting modules reads
    :param result: the result of that module: a mean, logits or scores
    :param squashed: the action before it is rescaled, as critics take it
    """

    policy: Any
    declared: type[BaseSparsePolicy]
    tracer: Tracer
    observation: int | Mapping[str, int]
    features: int
    latent: int
    result: int
    squashed: int

    def features_of(self, name: str) -> int:
        """Return the result of a features extractor, which may be the actor's.

        :param name: the extractor's name
        """
        extractor = module_of(self.policy, name)
        if extractor is module_of(self.policy, self.declared.acting[0]):
            return self.features
        return self.tracer.walk(extractor, self.observation)


def module_of(policy: Any, name: str) -> nn.Module:
    """Return a module of a policy.

    :raises UnsupportedError: if there is no module of that name
    """
    try:
        found: nn.Module = policy.get_submodule(name)
    except AttributeError as error:
        raise UnsupportedError(
            f"{type(policy).__name__} is not built as SB3's own policies are ({error}), so it "
            "cannot be exported"
        ) from error
    return found
