"""From observations to the results of networks, in one call of the kernels where it can be."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from torch import nn

from sb3_sparse.engine.inference import MOST_INPUTS, Inference, by_modules
from sb3_sparse.engine.kept import KeptInference
from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.engine.paths import Paths
from sb3_sparse.policies.storage import KNOWN

PREDICTS = ("_predict", "forward")
"""Methods of SB3's on the way from observations to actions."""


class Shortcut:
    """The way from observations to the results of networks, in one call where it can be.

    :param paths: modules of each network, from the features to the result, by dotted names
    :param on_the_way: methods of SB3's that it passes over, besides ``extract_features``; where
        somebody has one of his own, modules are called one by one
    """

    def __init__(
        self, paths: tuple[tuple[str, ...], ...], on_the_way: tuple[str, ...] = ()
    ) -> None:
        self._paths = paths
        self._on_the_way = ("extract_features", *on_the_way)
        self._flat = False
        self._direct = False
        self._kept = KeptInference()

    def __deepcopy__(self, memo: dict[int, Any]) -> Shortcut:
        return Shortcut(self._paths, self._on_the_way[1:])

    def __reduce__(self) -> Any:
        return Shortcut, (self._paths, self._on_the_way[1:])

    def inference(self, root: BaseModel) -> Inference | None:
        """What computes the networks at once; None where modules must be called one by one."""
        return self._kept.get(lambda: self._find(root))

    def _find(self, root: BaseModel) -> tuple[Paths, list[nn.Module]]:
        # Whoever counted on the kernels goes by the modules if they know them no more.
        for layer in MaskedStorage.below(root):
            layer.remask()
        if not untouched(root, self._on_the_way):
            return [], [root]
        paths = [[root.get_submodule(name) for name in path] for path in self._paths]
        around: list[nn.Module] = [root]
        for path in self._paths:
            for name in path:
                parts = name.split(".")[:-1]
                around += [root.get_submodule(".".join(parts[: i + 1])) for i in range(len(parts))]
        extractors = [
            module for module in root.children() if isinstance(module, BaseFeaturesExtractor)
        ]
        around = list({id(module): module for module in (*around, *extractors)}.values())
        known = all(type(module).__module__.partition(".")[0] in KNOWN for module in around[1:])
        self._flat = takes_vectors(root) and all(map(only_flattens, extractors))
        self._direct = self._flat and untouched(root, PREDICTS)
        if self._flat:
            around += [module for extractor in extractors for module in extractor.children()]
        return paths if known else [], around

    def results(
        self, root: BaseModel, obs: Any, extractor: str = "features_extractor"
    ) -> list[th.Tensor] | None:
        """Each network's result; None where modules must be called one by one.

        :param root: the policy or part
        :param obs: observations as SB3 hands them to ``forward``
        :param extractor: name of the features extractor that the networks share
        """
        if th.is_grad_enabled() or by_modules(obs) or not 0 < obs.shape[0] <= MOST_INPUTS:
            return None
        inference = self.inference(root)
        if inference is None:
            return None
        if self._flat:
            return inference.of_observations(obs)
        if inference.watched:
            return None  # before the extractor is called, which would be called twice
        features = BaseModel.extract_features(root, obs, getattr(root, extractor))
        return inference(features)

    def of_array(
        self, root: BaseModel, observations: NDArray[Any]
    ) -> list[NDArray[np.float32]] | None:
        """Each network's result; None where modules must be called one by one.

        :param root: the policy or part, whose ``_predict`` and ``forward`` are passed over too
        :param observations: shape ``(n, *shape of an observation)``, of any type
        """
        inference = self.inference(root)
        if inference is None or not self._direct or root._forward_hooks or root._forward_pre_hooks:
            return None
        return inference.of_array(observations)


def takes_vectors(root: BaseModel) -> bool:
    """Whether observations are numbers that SB3 only makes float."""
    space = root.observation_space
    return isinstance(space, spaces.Box) and not is_image_space(space)


def only_flattens(extractor: nn.Module) -> bool:
    """Whether it does no more than SB3's own for vectors."""
    flatten: Any = extractor._modules.get("flatten")
    return (
        type(extractor) is FlattenExtractor
        and type(flatten) is nn.Flatten
        and (flatten.start_dim, flatten.end_dim) == (1, -1)
    )


def untouched(module: nn.Module, names: tuple[str, ...]) -> bool:
    """Whether neither it nor a subclass of the user's own has a method of these names."""
    kind: Any = type(module)
    return vars(module).keys().isdisjoint(names) and _untouched(kind, names)


@cache
def _untouched(kind: Any, names: tuple[str, ...]) -> bool:
    """Whether no subclass of the user's own has these methods."""
    return all(getattr(kind, name).__module__.partition(".")[0] in KNOWN for name in names)
