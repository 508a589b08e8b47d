"""Translates a model of SBX (SB3 in JAX) to the model of SB3 that has the same parameters."""

from __future__ import annotations

from typing import Any

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space

from sb3_sparse.errors import MissingExtra, UnsupportedError
from sb3_sparse.export.flax_parameters import put
from sb3_sparse.export.sbx_networks import counterpart_of
from sb3_sparse.policies.internals import build_networks
from sb3_sparse.policies.registry import supported_algorithms

CARRIED = (
    "learning_rate", "buffer_size", "learning_starts", "batch_size", "tau", "gamma", "train_freq",
    "gradient_steps", "action_noise", "replay_buffer_class", "replay_buffer_kwargs",
    "optimize_memory_usage", "n_steps", "n_epochs", "gae_lambda", "vf_coef", "max_grad_norm",
    "clip_range", "normalize_advantage", "target_entropy", "policy_delay", "target_policy_noise",
    "target_noise_clip", "exploration_fraction", "exploration_initial_eps",
    "exploration_final_eps", "num_timesteps",
)  # fmt: skip
"""Attributes that mean the same in SBX and in SB3."""
NOT_CARRIED = (
    "critics, target networks and the entropy coefficient are those of the model of SBX. "
    "Optimizers start anew, and arguments that SB3 lacks, such as qf_learning_rate, are left out"
)
"""What a user must know of a model of SB3 that was one of SBX."""


def is_sbx_model(model: BaseAlgorithm) -> bool:
    """Tell whether an algorithm is one of SBX, or inherits from one."""
    return _algorithm_name(model) is not None


def as_sb3(model: BaseAlgorithm, whole: bool) -> BaseAlgorithm:
    """Return a model of SB3 that acts as a model of SBX does.

    :param whole: also copy what it needs to train on: critics, target networks, the entropy
        coefficient. Optimizers start anew
    :raises UnsupportedError: if parameters or spaces have no counterpart in SB3
    :raises MissingExtra: if its algorithm needs sb3-contrib, which is not installed
    """
    source: Any = model.policy
    counterpart = counterpart_of(source)
    kwargs = counterpart.kwargs(source) | counterpart.fixed
    policy = counterpart.policy
    _check_spaces(model, images=policy == "CnnPolicy")
    if isinstance(model.observation_space, spaces.Dict):
        policy = policy.replace("Mlp", "MultiInput")
    elif policy == "MlpPolicy" and is_image_space(model.observation_space):
        kwargs["normalize_images"] = False
    twin = _algorithm(model, policy, kwargs)
    counterpart.acting(source, twin.policy)
    if whole:
        counterpart.training(source, twin.policy)
        coefficient: Any = getattr(twin, "log_ent_coef", None)
        if coefficient is not None:
            learned: Any = model
            put(coefficient, [learned.ent_coef_state.params["log_ent_coef"]], "log_ent_coef")
    return twin


def _algorithm_name(model: BaseAlgorithm) -> str | None:
    """Return the name of the algorithm of SBX that a model is of; None: it is of none."""
    return next((c.__name__ for c in type(model).__mro__ if c.__module__.startswith("sbx.")), None)


def _algorithm(model: Any, policy: str, kwargs: dict[str, Any]) -> BaseAlgorithm:
    """Make the algorithm of SB3, with the hyperparameters that it has in common with SBX."""
    name = _algorithm_name(model)
    algorithm: Any = supported_algorithms().get(str(name))
    if algorithm is None:
        raise MissingExtra(f"a model of SBX's {name}", "contrib")
    twin = algorithm(policy, None, policy_kwargs=kwargs, device="cpu", _init_setup_model=False)
    for key in ("observation_space", "action_space", "n_envs"):
        setattr(twin, key, getattr(model, key))
    for key in CARRIED:
        if hasattr(twin, key) and hasattr(model, key):
            setattr(twin, key, getattr(model, key))
    if hasattr(model, "ent_coef_init") or name == "PPO":  # SAC's ent_coef is a network
        twin.ent_coef = getattr(model, "ent_coef_init", model.ent_coef)
    if hasattr(twin, "top_quantiles_to_drop_per_net"):
        twin.top_quantiles_to_drop_per_net = model.policy.top_quantiles_to_drop_per_net
    build_networks(twin)
    if hasattr(model, "target_update_interval"):
        twin.target_update_interval = model.target_update_interval
    twin.seed = model.seed
    done: BaseAlgorithm = twin
    return done


def _check_spaces(model: BaseAlgorithm, images: bool) -> None:
    """Reject spaces that SBX and SB3 give to a network in different ways."""
    space, action = model.observation_space, model.action_space
    taken = (spaces.Box, spaces.MultiBinary)
    if images:
        fits = is_image_space(space)
    elif isinstance(space, spaces.Dict):
        fits = all(isinstance(p, taken) and len(p.shape) == 1 for p in space.spaces.values())
    else:
        fits = isinstance(space, taken)
    if not fits:
        raise UnsupportedError(
            f"a model of SBX with observations in {space} cannot be exported; allowed are Box, "
            "MultiBinary, a Dict of vectors of these, and for a CnnPolicy images"
        )
    if isinstance(action, spaces.MultiBinary):
        raise UnsupportedError(
            f"a model of SBX with actions in {action} cannot be exported: it has two outputs for "
            "each, SB3 one. Train it with MultiDiscrete actions of two choices each"
        )
