"""Settings of a run by name, wherever they lie, and what runs may be compared by."""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
from collections.abc import Iterable, Mapping
from typing import Any

from sb3_sparse.policies.config import SparsityConfig
from sb3_sparse.zoo.spec import algorithms

CALLBACK = "SparsityCallback"
CLASSIC = ("CartPole", "Acrobot", "MountainCar", "MountainCarContinuous", "Pendulum")
MUJOCO = (
    "Ant",
    "HalfCheetah",
    "Hopper",
    "Humanoid",
    "HumanoidStandup",
    "InvertedDoublePendulum",
) + ("InvertedPendulum", "Pusher", "Reacher", "Swimmer", "Walker2d")
ATARI, CONTROL, PHYSICS, OTHER = "Atari", "classic control", "MuJoCo", "other tasks"
# What is compared anyway. Widths follow from it in a dense network that matches a sparse one.
COMPARED = ("sparsity", "initial_sparsity", "method")
WIDTHS = ("net_arch", "features_extractor_class", "features_extractor_kwargs")


def game_of(env_id: str) -> str:
    """Name of a task without its version, e.g. ``"Pong"`` of ``"ALE/Pong-v5"``."""
    name = re.sub(r"-v\d+$", "", env_id.split("/")[-1])
    return re.sub(r"(-ram)?(NoFrameskip|Deterministic)?$", "", name)


def suite_of(env_id: str) -> str:
    """Which benchmark a task belongs to."""
    if env_id.startswith("ALE/") or "NoFrameskip" in env_id or "Deterministic" in env_id:
        return ATARI
    if game_of(env_id) in CLASSIC:
        return CONTROL
    return PHYSICS if game_of(env_id) in MUJOCO else OTHER


def family_of(algo: str, env_id: str, settings: Mapping[str, Any]) -> str:
    """What is compared with one another: algorithm, architecture and suite."""
    extractor = str(settings.get("policy_kwargs", {}).get("features_extractor_class", ""))
    resnet = " with the Impala ResNet" if "impala" in extractor.lower() else ""
    return f"{algo.upper()}{resnet} on {suite_of(env_id)}"


def callback_of(settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """Arguments of the mask's schedule; empty for a run without one."""
    given = settings.get("callback") or []
    for entry in given if isinstance(given, list) else [given]:
        if isinstance(entry, Mapping):
            for name, arguments in entry.items():
                if str(name).endswith(CALLBACK) and isinstance(arguments, Mapping):
                    return arguments
    return {}


def setting_of(algo: str, settings: Mapping[str, Any], name: str) -> Any:
    """A setting's value: of the policy, the mask's schedule or the algorithm; else its default.

    :return: ``"default"`` where the default depends on the method
    """
    for place in (settings.get("policy_kwargs", {}), callback_of(settings), settings):
        if name in place:
            return place[name]
    if name == "weight_decay":
        return 0.0
    for one in dataclasses.fields(SparsityConfig):
        if one.name == name and one.default is not dataclasses.MISSING:
            return one.default
    algorithm = algorithms().get(algo)
    if algorithm is not None:
        parameter = inspect.signature(algorithm).parameters.get(name)
        if parameter is not None and parameter.default is not parameter.empty:
            return parameter.default
    return "default"


def variant_of(settings: Mapping[str, Any], without: Iterable[str] = ()) -> str:
    """All settings but method and sparsity, as one comparable text.

    :param without: names of more settings that may differ
    """
    hidden = {*COMPARED, *without}

    def kept(values: Mapping[str, Any]) -> dict[str, Any]:
        return {name: value for name, value in values.items() if name not in hidden}

    top = {name: value for name, value in kept(settings).items() if name != "callback"}
    top["policy_kwargs"] = kept(settings.get("policy_kwargs") or {})
    top["callback"] = kept(callback_of(settings))
    return json.dumps(top, sort_keys=True, default=str)


def overrides_of(run: Mapping[str, Any]) -> int:
    """How many settings a run changes in its config."""
    others = sum(run.get(name) is not None for name in ("distribution", "conf_file", "entry"))
    return len(run.get("hyperparams") or {}) + others
