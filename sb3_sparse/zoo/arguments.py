"""Allowed values of the arguments of SB3's algorithms and policies, and of rl-zoo.

SB3 checks few of them: text as ``learning_starts`` fails in the middle of training, ``gamma: 5``
trains nonsense, and ``buffer_size: 0`` becomes 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

from sb3_sparse.policies.registry import lineage
from sb3_sparse.sparsity.numeric import is_whole


@dataclass(frozen=True)
class Kind:
    """A kind of value that an argument accepts.

    :param allowed: its description, which follows "must be" in messages
    :param fits: whether a value is allowed
    """

    allowed: str
    fits: Callable[[Any], bool]

    def __or__(self, other: Kind) -> Kind:
        return Kind(f"{self.allowed}, or {other.allowed}", lambda v: self.fits(v) or other.fits(v))


def is_finite(value: Any) -> bool:
    """Whether a value is a finite number."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def _whole(low: int) -> Kind:
    return Kind(f"a whole number, {low} or more", lambda v: is_whole(v) and v >= low)


def _from(low: float) -> Kind:
    return Kind(f"a number, {low:g} or more", lambda v: is_finite(v) and v >= low)


def _between(low: float, high: float) -> Kind:
    return Kind(f"a number in [{low:g}, {high:g}]", lambda v: is_finite(v) and low <= v <= high)


def _word(*words: str) -> Kind:
    return Kind(" or ".join(map(repr, words)), lambda v: isinstance(v, str) and v in words)


def _after(prefix: str, of: Kind, text: str) -> Kind:
    """Accept a prefix followed by a number, as rl-zoo and SB3 parse it."""

    def fits(value: Any) -> bool:
        if not isinstance(value, str) or not value.startswith(prefix):
            return False
        try:
            return of.fits(float(value.removeprefix(prefix)))
        except ValueError:
            return False

    return Kind(text, fits)


def _frequency(value: Any) -> bool:
    return (
        isinstance(value, (tuple, list))
        and len(value) == 2
        and _whole(1).fits(value[0])
        and value[1] in ("step", "episode")
    )


def _widths(value: Any) -> bool:
    return isinstance(value, list) and all(is_whole(one) and one >= 1 for one in value)


def _two_widths(critic: str) -> Kind:
    """Accept separate widths of actor (``pi``) and critic."""

    def fits(value: Any) -> bool:
        named = isinstance(value, Mapping) and value.keys() == {"pi", critic}
        return named and all(map(_widths, value.values()))

    return Kind(f"{{pi: [64, 64], {critic}: [64, 64]}}", fits)


NONE = Kind("null (None)", lambda v: v is None)
FLAG = Kind("true or false", lambda v: isinstance(v, bool))
NUMBER = Kind("a number", is_finite)
POSITIVE = Kind("a number above 0", lambda v: is_finite(v) and v > 0)
SHARE = _between(0, 1)
MAPPING = Kind("a mapping of names to values", lambda v: isinstance(v, Mapping))
CODE = Kind("Python code, dict(...)", lambda v: isinstance(v, str) and bool(v.strip()))
CLASS = Kind(
    "a class or its dotted path, e.g. torch.nn.ReLU",
    lambda v: (
        isinstance(v, type) or (isinstance(v, str) and all(map(str.isidentifier, v.split("."))))
    ),
)
STEPS = _whole(1)
DECAY = "lin_ and a number for a linear decay to 0, e.g. lin_0.001"
AUTO = _word("auto") | _after("auto_", POSITIVE, "auto_ and an initial value, e.g. auto_0.1")
WRAPPER = (
    Kind(
        "a dotted path, a path with its arguments, or a list of these",
        lambda v: (
            isinstance(v, (str, Mapping))
            or (isinstance(v, list) and all(isinstance(one, (str, Mapping)) for one in v))
        ),
    )
    | NONE
)
SDE_FREQUENCY = Kind(
    "a whole number, 1 or more, or -1", lambda v: is_whole(v) and (v == -1 or v > 0)
)

ALGORITHM: dict[str, Kind] = {
    "action_noise": Kind("left out; give noise_type and noise_std", lambda v: v is None),
    "batch_size": STEPS,
    "buffer_size": STEPS,
    "cg_damping": _from(0),
    "cg_max_steps": STEPS,
    "clip_range": POSITIVE | _after("lin_", POSITIVE, DECAY),
    "clip_range_vf": POSITIVE | _after("lin_", POSITIVE, DECAY) | NONE,
    "ent_coef": NUMBER,
    "exploration_final_eps": SHARE,
    "exploration_fraction": SHARE,
    "exploration_initial_eps": SHARE,
    "gae_lambda": SHARE,
    "gamma": SHARE,
    "gradient_steps": Kind(
        "a whole number, 1 or more, or -1 for as many as environment steps", SDE_FREQUENCY.fits
    ),
    "learning_rate": _from(0) | _after("lin_", _from(0), DECAY),
    "learning_starts": _whole(0),
    "line_search_max_iter": STEPS,
    "line_search_shrinking_factor": Kind(
        "a number above 0 and below 1", lambda v: is_finite(v) and 0 < v < 1
    ),
    "max_grad_norm": Kind(
        "a number above 0 (.inf clips nothing)",
        lambda v: POSITIVE.fits(v) or (isinstance(v, Real) and v == math.inf),
    ),
    "n_critic_updates": STEPS,
    "n_epochs": STEPS,
    "n_steps": STEPS,
    "normalize_advantage": FLAG,
    "optimize_memory_usage": FLAG,
    "policy_delay": STEPS,
    "replay_buffer_class": CLASS | NONE,
    "replay_buffer_kwargs": MAPPING | CODE | NONE,
    "rms_prop_eps": POSITIVE,
    "rollout_buffer_class": CLASS | NONE,
    "rollout_buffer_kwargs": MAPPING | NONE,
    "sde_sample_freq": SDE_FREQUENCY,
    "stats_window_size": STEPS,
    "sub_sampling_factor": STEPS,
    "target_entropy": _word("auto") | NUMBER,
    "target_kl": POSITIVE | NONE,
    "target_noise_clip": _from(0),
    "target_policy_noise": _from(0),
    "target_update_interval": STEPS,
    "tau": SHARE,
    "top_quantiles_to_drop_per_net": _whole(0),
    "train_freq": STEPS | Kind("[1, episode] or [1, step]", _frequency),
    "use_rms_prop": FLAG,
    "use_sde": FLAG,
    "use_sde_at_warmup": FLAG,
    "vf_coef": _from(0),
}
_WIDTHS = Kind("a list of widths, e.g. [256, 256]", _widths) | NONE
_TUNED_ENTROPY = {"ent_coef": _from(0) | AUTO}
_OFF_POLICY = {"net_arch": _WIDTHS | _two_widths("qf")}
_ON_POLICY = {"net_arch": _WIDTHS | _two_widths("vf")}
OF_ONE = {  # for names that mean something else there
    "sac": {**_TUNED_ENTROPY, **_OFF_POLICY},
    "tqc": {**_TUNED_ENTROPY, **_OFF_POLICY},
    "crossq": {**_TUNED_ENTROPY, **_OFF_POLICY},
    "td3": _OFF_POLICY,
    "ddpg": _OFF_POLICY,
    "ppo": _ON_POLICY,
    "a2c": _ON_POLICY,
    "trpo": {"target_kl": POSITIVE, **_ON_POLICY},
    "qrdqn": {"max_grad_norm": ALGORITHM["max_grad_norm"] | NONE},
}
ZOO: dict[str, Kind] = {
    "callback": WRAPPER,
    "env_kwargs": MAPPING | NONE,
    "env_wrapper": WRAPPER,
    "frame_stack": STEPS | NONE,
    "monitor_kwargs": MAPPING | CODE,
    "n_envs": STEPS,
    "n_timesteps": Kind(
        "a whole number, 1 or more, e.g. 100000 or !!float 1e5",
        lambda v: is_finite(v) and v >= 1 and v == int(v),
    ),
    "noise_std": _from(0),
    "noise_type": _word("normal", "ornstein-uhlenbeck") | NONE,
    "normalize": FLAG | MAPPING | CODE,
    "policy": Kind("a name", lambda v: isinstance(v, str)),
    "policy_kwargs": MAPPING,
    "vec_env_wrapper": WRAPPER,
}
POLICY: dict[str, Kind] = {
    "activation_fn": CLASS,
    "batch_norm": FLAG,
    "batch_norm_eps": POSITIVE,
    "batch_norm_momentum": SHARE,
    "clip_mean": POSITIVE,
    "features_extractor_class": CLASS,
    "features_extractor_kwargs": MAPPING | NONE,
    "full_std": FLAG,
    "log_std_init": NUMBER,
    "n_critics": STEPS,
    "n_quantiles": STEPS,
    "net_arch": _WIDTHS,
    "normalize_images": FLAG,
    "optimizer_class": CLASS,
    "optimizer_kwargs": MAPPING | NONE,
    "ortho_init": FLAG,
    "renorm_warmup_steps": _whole(0),
    "share_features_extractor": FLAG,
    "squash_output": FLAG,
    "use_expln": FLAG,
    "use_sde": FLAG,
    "weight_decay": _from(0),
}


def kind_of(algo: str, name: str) -> Kind | None:
    """Return the kind of an argument, or None if the tables do not list it.

    :param algo: algorithm, e.g. ``"sac"``
    :param name: argument of the algorithm, its policy or rl-zoo; these names do not overlap
    """
    of_one = (OF_ONE.get(name, {}) for name in lineage(algo))
    for table in (*of_one, ALGORITHM, ZOO, POLICY):
        if name in table:
            return table[name]
    return None
