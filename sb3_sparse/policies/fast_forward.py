"""Forward passes of whole networks in one call of the kernels, where that is possible."""

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
from sb3_sparse.policies.storage import is_known

PREDICTS = ("_predict", "forward")
"""Methods of SB3 that :meth:`FastForward.from_numpy` bypasses too."""


class FastForward:
    """The forward pass of networks, from observations to outputs, in one call where possible.

    Otherwise it returns None, and the modules have to be called one by one.

    :param paths: dotted names of each network's modules, from the features to the output
    :param bypassed: methods of SB3 that are not called then, besides ``extract_features``. Where
        a user overrides one, the modules are called
    """

    def __init__(self, paths: tuple[tuple[str, ...], ...], bypassed: tuple[str, ...] = ()) -> None:
        self._paths = paths
        self._bypassed = ("extract_features", *bypassed)
        self._flat = False
        self._direct = False
        self._kept = KeptInference()

    def __deepcopy__(self, memo: dict[int, Any]) -> FastForward:
        return FastForward(self._paths, self._bypassed[1:])

    def __reduce__(self) -> Any:
        return FastForward, (self._paths, self._bypassed[1:])

    def inference(self, root: BaseModel) -> Inference | None:
        """The compiled networks; None: the modules have to be called."""
        return self._kept.get(lambda: self._find(root))

    def _find(self, root: BaseModel) -> tuple[Paths, list[nn.Module]]:
        # The kernels read masks; modules that they can no longer replace read the weights.
        for layer in MaskedStorage.below(root):
            layer.remask()
        if overrides(root, self._bypassed):
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
        known = all(is_known(type(module)) for module in around[1:])
        self._flat = takes_vectors(root) and all(map(only_flattens, extractors))
        self._direct = self._flat and not overrides(root, PREDICTS)
        if self._flat:
            around += [module for extractor in extractors for module in extractor.children()]
        return paths if known else [], around

    def results(
        self, root: BaseModel, obs: Any, extractor: str = "features_extractor"
    ) -> list[th.Tensor] | None:
        """The output of each network; None: the modules have to be called.

        :param root: the policy or module that has the networks
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

    def from_numpy(
        self, root: BaseModel, observations: NDArray[Any]
    ) -> list[NDArray[np.float32]] | None:
        """The output of each network; None: the modules have to be called.

        :param root: the policy or module; its ``_predict`` and ``forward`` are not called
        :param observations: shape ``(n, *shape of an observation)``, any dtype
        """
        inference = self.inference(root)
        if inference is None or not self._direct or root._forward_hooks or root._forward_pre_hooks:
            return None
        return inference.of_array(observations)


def takes_vectors(root: BaseModel) -> bool:
    """Whether observations are vectors, which SB3 only converts to float."""
    space = root.observation_space
    return isinstance(space, spaces.Box) and not is_image_space(space)


def only_flattens(extractor: nn.Module) -> bool:
    """Whether a features extractor is SB3's own for vectors, unchanged."""
    flatten: Any = extractor._modules.get("flatten")
    return (
        type(extractor) is FlattenExtractor
        and type(flatten) is nn.Flatten
        and (flatten.start_dim, flatten.end_dim) == (1, -1)
    )


def overrides(module: nn.Module, names: tuple[str, ...]) -> bool:
    """Whether an object, or a user's subclass, has methods of its own under these names."""
    kind: Any = type(module)
    return not vars(module).keys().isdisjoint(names) or _overrides(kind, names)


@cache
def _overrides(kind: Any, names: tuple[str, ...]) -> bool:
    return not all(is_known(getattr(kind, name)) for name in names)
