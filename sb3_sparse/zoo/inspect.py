"""Looking into a saved model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_sparse.engine.auto import Choice, choose
from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.mixin import SparsePolicyMixin
from sb3_sparse.policies.report import SparsityReport
from sb3_sparse.zoo.saved import arguments_of, is_run, model_in, read_zip, zip_path
from sb3_sparse.zoo.speed import use_few_threads


@dataclass(frozen=True)
class Inspection:
    """What a saved model is.

    :param report: its layers
    :param choice: what ``compute="auto"`` would choose on this machine
    :param compute: what it was made with
    """

    report: SparsityReport
    choice: Choice
    compute: str

    def __str__(self) -> str:
        parts = [str(self.report), "", f"On this machine {self.choice}"]
        if self.choice.layers:
            parts.append(self.choice.table())
        if self.compute != "auto":
            parts.append(f"The model was made with compute={self.compute!r}, so nothing is chosen.")
        return "\n".join(parts)


def _load(path: Path) -> tuple[SparsePolicyMixin, dict[str, Any]]:
    """The sparse policy in a zip that SB3 saved, whichever algorithm trained it, and its data.

    :raises ConfigError: if there is no such file, or no sparse policy in it
    """
    if is_run(path):
        path = model_in(path, arguments_of(path)["env"], False)
    path = zip_path(path)
    data, state = read_zip(path)
    policy_class = data.get("policy_class")
    if not (isinstance(policy_class, type) and issubclass(policy_class, SparsePolicyMixin)):
        name = getattr(policy_class, "__name__", "none")
        raise ConfigError(f"the policy in {path} is not sparse but {name}")
    kwargs = {**data["policy_kwargs"], "compute": "masked"}  # which every machine can
    if data["use_sde"]:
        kwargs["use_sde"] = True
    policy = policy_class(
        data["observation_space"], data["action_space"], policy_class._dummy_schedule, **kwargs
    )
    policy.load_state_dict(state)
    return policy, data


def inspect_model(path: Path) -> Inspection:
    """The sparsity report of a saved model, and how its layers would best be computed here."""
    policy, data = _load(path)
    batch = data.get("batch_size") or data["n_steps"] * data["n_envs"]  # A2C: the whole rollout
    use_few_threads(policy.observation_space)
    return Inspection(
        report=policy.sparsity_report(),
        choice=choose(policy, list(policy.sparse.layers), batch),
        compute=data["policy_kwargs"].get("compute", "auto"),
    )
