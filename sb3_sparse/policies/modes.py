"""Training and evaluation mode, switched without a walk over all modules."""

from __future__ import annotations

from collections.abc import Callable
from operator import itemgetter
from typing import Any

from stable_baselines3.common.policies import BaseModel
from torch import nn

from sb3_sparse.engine.changes import ChangeDetector
from sb3_sparse.policies.storage import KNOWN

SetMode = Callable[[bool], None]
SWITCHES = ("train", "set_training_mode")
TRAINING = itemgetter("training")


class Modes:
    """Which modules SB3's ``set_training_mode`` switches, found out by doing it once.

    SB3 walks over every module at each prediction and each round of training. The same flags are
    set here directly, as long as the modules are the same. Copies and pickles begin anew.
    """

    def __init__(self) -> None:
        self._changes: ChangeDetector | None = None
        self._switched: list[dict[str, Any]] = []

    def __deepcopy__(self, memo: dict[int, Any]) -> Modes:
        return Modes()

    def __reduce__(self) -> Any:
        return Modes, ()

    def switch(self, root: nn.Module, set_mode: SetMode, mode: bool) -> bool:
        """Set the mode; whether the modules were still the same.

        :param root: the policy or part
        :param set_mode: SB3's way, which walks
        :param mode: True for training
        """
        if self._changes is not None and self._changes.unchanged():
            for attributes in self._switched:
                attributes["training"] = mode
            return True
        self._learn(root, set_mode, mode)
        return False

    @property
    def off(self) -> bool:
        """Whether what it last switched is in evaluation mode."""
        return self._changes is not None and not any(map(TRAINING, self._switched))

    def _learn(self, root: nn.Module, set_mode: SetMode, mode: bool) -> None:
        self._changes = None
        modules = list(root.modules())
        if any(_has_own_way(module) for module in modules):
            set_mode(mode)
            return
        set_mode(not mode)
        before = [module.training for module in modules]
        set_mode(mode)
        self._switched = [
            vars(module)
            for module, was in zip(modules, before, strict=True)
            if module.training is not was
        ]
        self._changes = ChangeDetector(modules, tensors=False)


def _has_own_way(module: nn.Module) -> bool:
    """Whether it does more than set a flag, e.g. stays in evaluation mode for ever."""
    if type(module).train is not nn.Module.train or not vars(module).keys().isdisjoint(SWITCHES):
        return True
    switch = getattr(type(module), "set_training_mode", None)
    return switch is not None and switch.__module__.partition(".")[0] not in KNOWN


class SwitchesModes(BaseModel):
    """A policy or part of one that is put into training mode without a walk over its modules."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._modes = Modes()

    def set_training_mode(self, mode: bool) -> None:
        """As in SB3."""
        self._switch(mode)

    def _evaluate(self) -> None:
        """Be in evaluation mode, for what calls none of the modules."""
        if not self._modes.off:
            self._switch(False)

    def _switch(self, mode: bool) -> bool:
        """Set the mode; whether all modules were the same as at the last switch.

        :param mode: True for training
        """
        return self._modes.switch(self, super().set_training_mode, mode)
