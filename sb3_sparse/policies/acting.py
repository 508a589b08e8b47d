"""Predictions of a few observations, as in a rollout: SB3's results with fewer steps on the way."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BaseModel, BasePolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from torch import nn

from sb3_sparse.engine.chains import watched
from sb3_sparse.engine.inference import MOST_INPUTS, Inference, KeptInference
from sb3_sparse.engine.masked import MaskedLayer
from sb3_sparse.engine.paths import Paths
from sb3_sparse.policies.modes import Modes
from sb3_sparse.policies.storage import KNOWN

Actions = NDArray[Any]
ON_THE_WAY = (
    "set_training_mode",
    "obs_to_tensor",
    "is_vectorized_observation",
    "extract_features",
    "forward",
    "_predict",
    "unscale_action",
)
"""What ``predict`` calls; a subclass of the user's own that has one of them gets SB3's."""


class SwitchesModes(BaseModel):
    """A policy or part of one that is put into training mode without a walk over its modules."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._modes = Modes()

    def set_training_mode(self, mode: bool) -> None:
        """As in SB3."""
        self._switch(mode)

    def _switch(self, mode: bool) -> bool:
        """Set the mode; whether all modules were the same as at the last switch."""
        return self._modes.switch(self, super().set_training_mode, mode)


class Acts(SwitchesModes, BasePolicy):
    """A policy or part of one that predicts."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        space = self.observation_space
        self._takes_vectors = isinstance(space, spaces.Box) and not is_image_space(space)

    def predict(
        self,
        observation: Any,
        state: tuple[Actions, ...] | None = None,
        episode_start: Actions | None = None,
        deterministic: bool = False,
    ) -> tuple[Actions, tuple[Actions, ...] | None]:
        """As in SB3."""
        actions = self._predicted(observation, deterministic)
        if actions is None:
            self._enforce()
            return super().predict(observation, state, episode_start, deterministic)
        return actions, state

    def _predicted(self, observation: Any, deterministic: bool) -> Actions | None:
        """Actions for vectors of numbers; None for anything else, about which SB3 knows more."""
        if (
            type(observation) is not np.ndarray
            or not self._takes_vectors
            or not untouched(self, ON_THE_WAY)
        ):
            return None
        shape, acts = self.observation_space.shape or (), self.action_space.shape or ()
        alone = observation.shape == shape
        if not alone and observation.shape[1:] != shape:
            return None
        obs = th.from_numpy(np.array(observation).reshape((-1, *shape)))
        if not self._prepare_to_act(len(obs)):
            obs = obs.to(self.device)
        with th.no_grad():
            acted = self._predict(obs, deterministic)
        actions: Actions = acted.cpu().numpy().reshape((-1, *acts))
        if isinstance(self.action_space, spaces.Box):
            if self.squash_output:
                actions = self.unscale_action(actions)
            else:
                actions = np.clip(actions, self.action_space.low, self.action_space.high)
        return actions.squeeze(axis=0) if alone else actions

    def _enforce(self) -> None:
        """Set inactive weights to 0."""
        raise NotImplementedError

    def _prepare_to_act(self, count: int) -> bool:
        """Be in evaluation mode; whether the kernels will act.

        If not, inactive weights are set to 0, since modules will read them.

        :param count: number of observations
        """
        raise NotImplementedError


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
        self._whole = False
        self._kept = KeptInference()

    def __deepcopy__(self, memo: dict[int, Any]) -> Shortcut:
        return Shortcut(self._paths, self._on_the_way[1:])

    def __reduce__(self) -> Any:
        return Shortcut, (self._paths, self._on_the_way[1:])

    def inference(self, root: nn.Module) -> Inference | None:
        """What computes the networks at once; None where modules must be called one by one."""
        return self._kept.get(lambda: self._find(root))

    @property
    def found(self) -> bool:
        """Whether the kernels knew all modules with masks the last time, and on the CPU."""
        return self._kept.found and self._whole

    def _find(self, root: nn.Module) -> tuple[Paths, list[nn.Module]]:
        # Whoever counted on the kernels goes by the modules if they know them no more.
        for module in root.modules():
            if (layer := MaskedLayer.of(module)) is not None:
                layer.remask()
        if not untouched(root, self._on_the_way):
            return [], [root]
        paths = [[root.get_submodule(name) for name in path] for path in self._paths]
        around = [root]
        for path in self._paths:
            for name in path:
                parts = name.split(".")[:-1]
                around += [root.get_submodule(".".join(parts[: i + 1])) for i in range(len(parts))]
        extractors = [
            module for module in root.children() if isinstance(module, BaseFeaturesExtractor)
        ]
        around = list({id(module): module for module in (*around, *extractors)}.values())
        known = all(type(module).__module__.partition(".")[0] in KNOWN for module in around[1:])
        self._flat = all(map(_only_flattens, extractors))
        self._whole = not any(
            MaskedLayer.of(module) for extractor in extractors for module in extractor.modules()
        )
        if self._flat:
            around += [module for extractor in extractors for module in extractor.children()]
        return paths if known else [], around

    def results(
        self, root: Acts, obs: Any, extractor: BaseFeaturesExtractor
    ) -> list[th.Tensor] | None:
        """Each network's result; None where modules must be called one by one.

        :param root: the policy or part
        :param obs: observations as SB3 hands them to ``forward``
        :param extractor: the features extractor that the networks share
        """
        if th.is_grad_enabled() or watched(obs) or not 0 < obs.shape[0] <= MOST_INPUTS:
            return None
        inference = self.inference(root)
        if inference is None:
            return None
        if root._takes_vectors and self._flat:
            return inference(obs.float().flatten(1))
        if inference.watched:
            return None  # before the extractor is called, which would be called twice
        return inference(BaseModel.extract_features(root, obs, extractor))


def _only_flattens(extractor: nn.Module) -> bool:
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
