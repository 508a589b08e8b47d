"""The specification of a run: names and numbers, checked when it is made."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_sparse.algorithms.table import algorithm_named
from sb3_sparse.errors import ConfigError, did_you_mean
from sb3_sparse.policies.registry import algorithm_names
from sb3_sparse.sparsity.distributions import check_distribution, check_sparsity
from sb3_sparse.sparsity.numeric import is_whole
from sb3_sparse.topology import Methods
from sb3_sparse.zoo.arguments import MAPPING, Kind
from sb3_sparse.zoo.configs import (
    DENSE,
    config_folders,
    config_path,
    entries_of,
    entry_of,
    evaluation_of,
    is_preset,
)
from sb3_sparse.zoo.environments import (
    import_packages,
    is_atari,
    known_environment,
    package_names,
    plain_id,
    register_suite,
)
from sb3_sparse.zoo.settings import Settings

if TYPE_CHECKING:  # imported when settings are checked, not when a run is named
    from stable_baselines3.common.base_class import BaseAlgorithm

_TEXT = Kind("a text", lambda v: isinstance(v, str))
_WHOLE = Kind("a whole number, e.g. 100000", is_whole)
COUNTS = ("n_timesteps", "n_envs", "eval_freq", "eval_episodes")
TYPES = {
    **dict.fromkeys(("algo", "env_id", "device", "method", "conf_file"), _TEXT),
    **dict.fromkeys(("hyperparams", "entry"), MAPPING),
    **dict.fromkeys(("seed", *COUNTS), _WHOLE),
}
OPTIONAL = frozenset({"method", "conf_file", "entry", *COUNTS})


@dataclass(frozen=True)
class RunSpec:
    """The specification of a run. None leaves a value to the config.

    Example::

        from sb3_sparse.zoo import RunSpec

        run = RunSpec(algo="sac", env_id="Pendulum-v1", method="rigl", sparsity=0.9, seed=1)
        print(run.settings().policy_kwargs)

    :param algo: algorithm, e.g. ``"sac"``
    :param env_id: Gymnasium id; ``"package:Id-v0"`` is ``"Id-v0"`` with one more package
    :param method: ``"dense"``, a topology method, a method for each network
        (``{"actor": "static", "critic": "rigl"}`` or ``"actor=static,critic=rigl"``) or a preset,
        i.e. another folder of the shipped configs; None: that of ``conf_file``, else RigL
    :param sparsity: removed fraction, in [0, 1)
    :param distribution: ``"erk"``, ``"er"`` or ``"uniform"``
    :param seed: seed of all random numbers
    :param n_timesteps: environment steps
    :param n_envs: number of parallel environments
    :param device: as in SB3
    :param hyperparams: further values that replace the config's, by name: arguments of the
        algorithm, the policy, the SparsityCallback or rl-zoo
    :param conf_file: your own YAML file in rl-zoo's form, or the name of another shipped one, e.g.
        ``"dqn_impala"``; None: the shipped file of the method and the algorithm
    :param match_params: train a dense network with as many parameters as this sparsity leaves
    :param eval_freq: environment steps between two evaluations
    :param eval_episodes: episodes of one evaluation
    :param entry: settings to use instead of the config's entry for the environment
    :param gym_packages: modules to import that register environments or algorithms, as with
        rl-zoo's ``--gym-packages``
    :raises ConfigError: for a name or value that is not allowed
    """

    algo: str = "dqn"
    env_id: str = "CartPole-v1"
    method: str | Mapping[str, str] | None = None
    sparsity: float | None = None
    distribution: str | None = None
    seed: int = 0
    n_timesteps: int | None = None
    n_envs: int | None = None
    device: str = "auto"
    hyperparams: Mapping[str, Any] = field(default_factory=dict)
    conf_file: str | None = None
    match_params: float | None = None
    eval_freq: int | None = None
    eval_episodes: int | None = None
    entry: Mapping[str, Any] | None = None
    gym_packages: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for one in fields(self):  # JSON takes Python's numbers, but not NumPy's
            object.__setattr__(self, one.name, plain(getattr(self, one.name)))
        if isinstance(self.method, Mapping):
            object.__setattr__(self, "method", Methods.of(self.method).label)
        elif isinstance(self.method, str) and "=" in self.method:
            object.__setattr__(self, "method", Methods.parse(self.method).label)
        self._check_types()
        env_id, packages = plain_id(self.env_id, package_names(self.gym_packages))
        object.__setattr__(self, "env_id", env_id)
        object.__setattr__(self, "gym_packages", packages)
        import_packages(packages)
        known = [name.lower() for name in algorithm_names()]
        if self.algo not in known:
            raise ConfigError(
                f"unknown algorithm {self.algo!r}{did_you_mean(self.algo, known)}; allowed are "
                f"{', '.join(known)} (tqc, qrdqn, crossq and trpo need sb3-sparse[contrib]; "
                "--gym-packages names a module that registers your own algorithms)"
            )
        known_environment(env_id)
        if self.sparsity is not None:
            check_sparsity(self.sparsity)
        if self.distribution is not None:
            check_distribution(self.distribution)
        for name in COUNTS:
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigError(f"{name} must be 1 or more, got {value}")
        if not 0 <= self.seed < 2**31:
            raise ConfigError(f"the seed must lie in [0, 2^31), got {self.seed}")
        if self.match_params is not None:
            check_sparsity(self.match_params, "match_params")

    def _check_types(self) -> None:
        for name, kind in TYPES.items():
            value = getattr(self, name)
            optional = name in OPTIONAL and value is None
            if not optional and not kind.fits(value):
                raise ConfigError(f"{name} must be {kind.allowed}, got {value!r}")

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Unpickle in a worker, where the environment may not be registered yet."""
        vars(self).update(state)
        import_packages(self.gym_packages)
        register_suite(self.env_id)

    @property
    def algorithm(self) -> type[BaseAlgorithm]:
        """The algorithm's class."""
        return algorithms()[self.algo]

    @property
    def config(self) -> Path:
        """The YAML file that the settings come from."""
        if self._has_own_file:
            return Path(str(self.conf_file))
        by_network = self._by_network
        folder = self._method or "rigl"
        if by_network is not None:
            shipped = config_folders()
            folder = next((name for name in by_network.moving if name in shipped), "static")
        return config_path(folder, self.conf_file or self.algo)

    @property
    def _has_own_file(self) -> bool:
        return self.conf_file is not None and _is_path(self.conf_file)

    @property
    def _method(self) -> str | None:
        """The method as text."""
        assert not isinstance(self.method, Mapping)  # since it was made
        return self.method

    @property
    def _by_network(self) -> Methods | None:
        """The methods, if each network has its own."""
        return Methods.parse(self._method) if self._method and "=" in self._method else None

    @property
    def preset(self) -> str | None:
        """The preset that the settings come from."""
        return self._method if self._method is not None and is_preset(self._method) else None

    def name_of(self, settings: Settings) -> str:
        """Return what reports call the method: a preset that says how masks move, or the method.

        :param settings: the run's settings
        """
        if settings.is_dense:
            return DENSE
        moves = settings.methods is not None and settings.methods.options
        return self.preset if self.preset and moves else settings.method

    def config_entry(self) -> dict[str, Any]:
        """Return a copy of the config's entry for the environment.

        :raises ConfigError: if the config has none
        """
        if self.entry is not None:
            return deepcopy(dict(self.entry))
        entry = entry_of(self.config, self.env_id, is_atari(self.env_id))
        if self._by_network is not None and not self._has_own_file:
            entry = Settings(entry).with_methods(self._by_network).as_dict()
        return entry

    def settings(self) -> Settings:
        """Return the config's entry with everything that this run changes in it.

        :raises ConfigError: if the config has no entry, or its entry contradicts the run
        """
        settings = Settings(self.config_entry())
        method = settings.method
        from_preset = self.preset and (self.entry is not None or not self._has_own_file)
        if self.preset and self.entry is not None:
            self._check_entry_of(self.preset, settings)
        if self.method not in (None, method) and not from_preset:
            raise ConfigError(
                f"{self.config} trains with method {method!r}, not {self.method!r}; leave --method "
                "out, or change the file"
            )
        if method == DENSE and self.sparsity is not None:
            raise ConfigError(
                "dense training has no sparsity; leave --sparsity out, or give --match-params "
                f"{self.sparsity} for the dense network of equal parameter count"
            )
        from sb3_sparse.zoo.validation import check_settings

        wanted = {
            name: getattr(self, name)
            for name in ("sparsity", "distribution", "n_timesteps", "n_envs")
            if getattr(self, name) is not None
        }
        settings = settings.changed({**self.hyperparams, **wanted}, self.algorithm)
        check_settings(settings, self.algorithm)
        if settings.method != method:
            raise ConfigError(
                f"your changes make this {settings.method!r} training, not {method!r}; "
                f"choose it with --method {settings.method}"
            )
        if "n_timesteps" not in settings:
            raise ConfigError(
                f"the settings of {self.env_id} in {self.config} lack n_timesteps; add it there or "
                "give -n"
            )
        if self.match_params is not None and not settings.is_dense:
            add = f"--method {self.preset} --sparsity 0" if self.preset else "--method dense"
            raise ConfigError(
                f"--match-params trains the dense network that has as many parameters as the "
                f"sparse one, and {method!r} is not dense; give {add}"
            )
        return settings.replaced(n_timesteps=int(settings["n_timesteps"]))

    def _check_entry_of(self, preset: str, settings: Settings) -> None:
        """Require of an entry given for a preset that it is one of its kind."""
        entries = (Settings(entry) for entry in entries_of(preset))
        if settings.kind not in {one.kind for one in entries}:
            policy, method, callbacks = settings.kind
            beside = f" and the callbacks {', '.join(callbacks)}" if callbacks else ""
            raise ConfigError(
                f"the entry trains {policy} with method {method!r}{beside}, which is not the "
                f"preset {preset!r}; give its own method, or take the preset's entry"
            )

    def evaluation(self) -> dict[str, int]:
        """Return ``eval_freq`` and ``eval_episodes``."""
        schedule = evaluation_of(self.algo, self.env_id, is_atari(self.env_id))
        given = {name: getattr(self, name) for name in schedule}
        return {name: given[name] or value for name, value in schedule.items()}

    def as_dict(self) -> dict[str, Any]:
        """Return plain values from which ``RunSpec(**values)`` makes an equal run."""
        values = {**asdict(self), "hyperparams": dict(self.hyperparams)}
        packages = values.pop("gym_packages")  # omitted if empty, as in old files
        return {**values, "gym_packages": list(packages)} if packages else values


def plain(value: Any) -> Any:
    """Replace NumPy's numbers and arrays by Python's, inside mappings and lists too."""
    if isinstance(value, (np.generic, np.ndarray)):
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return {key: plain(one) for key, one in value.items()}
    if type(value) in (list, tuple):
        return type(value)(map(plain, value))
    return value


def _is_path(text: str) -> bool:
    path = Path(text)
    return path.suffix in (".yml", ".yaml") or len(path.parts) > 1 or path.exists()


def algorithms() -> dict[str, type[BaseAlgorithm]]:
    """Return the supported algorithms by lower-case name."""
    return {name.lower(): algorithm_named(name) for name in algorithm_names()}
