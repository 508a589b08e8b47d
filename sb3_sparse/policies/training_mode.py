"""Switches between training and evaluation mode without walking over all modules."""

from __future__ import annotations

from collections.abc import Callable
from operator import itemgetter
from typing import Any

from stable_baselines3.common.policies import BaseModel
from torch import nn

from sb3_sparse.engine.changes import ChangeDetector
from sb3_sparse.policies.storage import is_known

SetMode = Callable[[bool], None]
SWITCHES = ("train", "set_training_mode")
TRAINING = itemgetter("training")


class ModeSwitch:
    """Remembers which modules SB3's ``set_training_mode`` switches, and sets their flags directly.

    SB3 walks over every module at each prediction and each round of training. Here it does so once,
    and again when modules have changed. Copies and pickles start without a memory.
    """

    def __init__(self) -> None:
        self._changes: ChangeDetector | None = None
        self._switched: list[dict[str, Any]] = []

    def __deepcopy__(self, memo: dict[int, Any]) -> ModeSwitch:
        return ModeSwitch()

    def __reduce__(self) -> Any:
        return ModeSwitch, ()

    def switch(self, root: nn.Module, set_mode: SetMode, mode: bool) -> bool:
        """Set the mode.

        :param root: the policy or module
        :param set_mode: SB3's method, which walks over the modules
        :param mode: True for training
        :return: whether the modules were the same as at the last switch
        """
        if self._changes is not None and self._changes.unchanged():
            for attributes in self._switched:
                attributes["training"] = mode
            return True
        self._switch_and_remember(root, set_mode, mode)
        return False

    @property
    def in_evaluation_mode(self) -> bool:
        """Whether the modules that it last switched are in evaluation mode."""
        return self._changes is not None and not any(map(TRAINING, self._switched))

    def _switch_and_remember(self, root: nn.Module, set_mode: SetMode, mode: bool) -> None:
        self._changes = None
        modules = list(root.modules())
        if any(_does_more(module) for module in modules):
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


def _does_more(module: nn.Module) -> bool:
    """Whether switching a module does more than set a flag: some stay in evaluation mode."""
    if type(module).train is not nn.Module.train or not vars(module).keys().isdisjoint(SWITCHES):
        return True
    switch = getattr(type(module), "set_training_mode", None)
    return switch is not None and not is_known(switch)


class FastModeSwitch(BaseModel):
    """A policy, or a module of one, with a :class:`ModeSwitch`."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._mode_switch = ModeSwitch()

    def set_training_mode(self, mode: bool) -> None:
        """As in SB3."""
        self._switch(mode)

    def _ensure_evaluation_mode(self) -> None:
        """Switch to evaluation mode, as the bypassed methods of SB3 would."""
        if not self._mode_switch.in_evaluation_mode:
            self._switch(False)

    def _switch(self, mode: bool) -> bool:
        """Set the mode.

        :param mode: True for training
        :return: whether the modules were the same as at the last switch
        """
        return self._mode_switch.switch(self, super().set_training_mode, mode)
