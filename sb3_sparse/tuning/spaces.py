"""Search spaces: hyperparameters, and the values that each may take."""

from __future__ import annotations

import math
from collections.abc import Mapping, Set
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

from sb3_sparse.errors import ConfigError
from sb3_sparse.topology import Methods
from sb3_sparse.tuning.backend import BaseDistribution, Trial, optuna, quiet_optuna
from sb3_sparse.zoo.configs import DENSE
from sb3_sparse.zoo.spec import RunSpec

CategoricalDistribution = optuna.distributions.CategoricalDistribution
FloatDistribution = optuna.distributions.FloatDistribution
IntDistribution = optuna.distributions.IntDistribution

OF_SPARSE_POLICIES = frozenset({"sparsity", "distribution", "actor_share", "sparsity_aware_init"})
BRANCHES = 32
OPTIONS = ("sparsity", "distribution", "n_envs")  # of a run, beside its hyperparams
OF_METHODS = frozenset({"update_interval", "drop_fraction", "begin", "end", "update_on"})


@dataclass(frozen=True)
class Space:
    """Hyperparameters to search, by the names that ``--hyperparams`` knows.

    :param name: name of the space, for the search's name and for messages
    :param distributions: Optuna's distribution of each; empty if ``code`` samples
    :param code: Python source that defines ``space``, a function of an Optuna trial that returns
        the values by name
    :raises ConfigError: for an empty space, for bounds that are not finite, and for choices that
        are nan or occur twice

    Example::

        from optuna.distributions import CategoricalDistribution, FloatDistribution
        from sb3_sparse.tuning import Space

        space = Space(
            "mine",
            {
                "weight_decay": FloatDistribution(1e-7, 1e-3, log=True),
                "update_interval": CategoricalDistribution([100, 1000]),
            },
        )
    """

    name: str
    distributions: Mapping[str, BaseDistribution] = field(default_factory=dict)
    code: str | None = None

    def __post_init__(self) -> None:
        if not self.distributions and self.code is None:
            raise ConfigError(
                f"the search space {self.name!r} is empty: it must name at least one "
                "hyperparameter, e.g. weight_decay: [0.0, 1.0e-4]"
            )
        for name, distribution in self.distributions.items():
            _check_distribution(name, distribution, self.name)

    def sample(self, trial: Trial) -> dict[str, Any]:
        """Sample values for a trial, by name.

        :raises ConfigError: if the user's function fails, or does not return a mapping
        """
        if self.code is not None:
            return self._call(trial)
        return {name: _suggest(trial, name, d) for name, d in self.distributions.items()}

    def _call(self, trial: Trial) -> dict[str, Any]:
        function = run_code(str(self.code), self.name)
        try:
            values = function(trial)
        except optuna.TrialPruned:
            raise
        except Exception as error:
            raise ConfigError(
                f"space(trial) in {self.name} fails: {type(error).__name__}: {error}"
            ) from error
        if not isinstance(values, Mapping) or not values:
            raise ConfigError(
                f"space(trial) in {self.name} must return the sampled values by name, e.g. "
                "{'weight_decay': trial.suggest_float('weight_decay', 1e-7, 1e-2)}, got "
                f"{values!r}"
            )
        for name, value in values.items():
            if isinstance(value, float) and math.isnan(value):
                raise ConfigError(f"space(trial) in {self.name} gives {name} the value nan")
        return dict(values)

    @property
    def grid(self) -> dict[str, list[Any]] | None:
        """The choices of each hyperparameter; None if one has no choices."""
        if not self.distributions:
            return None
        choices = {}
        for name, distribution in self.distributions.items():
            if not isinstance(distribution, CategoricalDistribution):
                return None
            choices[name] = list(distribution.choices)
        return choices

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, which are equal for equal spaces."""
        to_json = optuna.distributions.distribution_to_json
        texts = {name: to_json(d) for name, d in sorted(self.distributions.items())}
        return {"name": self.name, "code": self.code, "distributions": texts}

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> Space:
        """Make the space that :meth:`as_dict` described."""
        of = optuna.distributions.json_to_distribution
        return Space(
            values["name"],
            {name: of(text) for name, text in values["distributions"].items()},
            values["code"],
        )


def _check_distribution(name: str, distribution: BaseDistribution, space: str) -> None:
    where = f"{name} in the search space {space!r}"
    if isinstance(distribution, CategoricalDistribution):
        known: list[Any] = []
        for choice in distribution.choices:
            if isinstance(choice, float) and math.isnan(choice):
                raise ConfigError(
                    f"{where} has the choice nan, which is not a number; leave it out"
                )
            if any(type(one) is type(choice) and one == choice for one in known):
                raise ConfigError(
                    f"{where} has the choice {choice!r} twice, so the same would be trained twice; "
                    "leave one out, and give --seeds for more runs a trial"
                )
            known.append(choice)
        return
    assert isinstance(distribution, (FloatDistribution, IntDistribution))
    for end in (distribution.low, distribution.high, distribution.step):
        if end is not None and not math.isfinite(end):
            raise ConfigError(
                f"{where} must lie between finite numbers, e.g. {{low: 1.0e-5, high: 0.01}}, got "
                f"{distribution.low} to {distribution.high}"
            )


def _suggest(trial: Trial, name: str, distribution: BaseDistribution) -> Any:
    if isinstance(distribution, CategoricalDistribution):
        return trial.suggest_categorical(name, distribution.choices)
    assert isinstance(distribution, (FloatDistribution, IntDistribution))
    low, high, log = distribution.low, distribution.high, distribution.log
    if isinstance(distribution, IntDistribution):
        return trial.suggest_int(name, int(low), int(high), step=distribution.step, log=log)
    return trial.suggest_float(name, low, high, step=distribution.step, log=log)


def run_code(code: str, name: str) -> Any:
    """Return what a Python source defines as ``space``.

    :param name: name of the file, for messages
    :raises ConfigError: if it fails, or does not define a mapping or a function
    """
    names: dict[str, Any] = {"__name__": "space"}
    try:
        exec(compile(code, name, "exec"), names)
    except Exception as error:
        raise ConfigError(f"{name} fails: {type(error).__name__}: {error}") from error
    found = names.get("space")
    if not (isinstance(found, Mapping) or callable(found)):
        raise ConfigError(
            f"{name} must define `space`: a mapping of hyperparameters to choices, or a function "
            f"of an Optuna trial that returns them; got {found!r}"
        )
    return found


def with_values(run: RunSpec, values: Mapping[str, Any]) -> RunSpec:
    """Return the run with sampled values among its hyperparameters."""
    return replace(run, hyperparams={**run.hyperparams, **values})


@quiet_optuna()
def samples_of(space: Space) -> list[dict[str, Any]]:
    """Return samples of a space, always the same; of a function, enough to see its branches."""
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    samples = []
    for _ in range(1 if space.code is None else BRANCHES):
        with suppress(optuna.TrialPruned):  # a function may reject its values
            samples.append(space.sample(study.ask()))
    return samples


def one_of_each(space: Space) -> dict[str, Any]:
    """Return one value of each name that the space may give."""
    return {name: value for values in samples_of(space) for name, value in values.items()}


def check_space(space: Space, run: RunSpec) -> None:
    """Check that a run can take a space's values, before anything is trained.

    It tries samples, and in one of them every choice and both ends of every range.

    :raises ConfigError: for a name that algorithm, policy and method do not have, for one that the
        run has fixed, and for a value that is not allowed
    """
    samples = samples_of(space)
    _check_names(space, run, {name for values in samples for name in values})
    for values in samples:
        with_values(run, values).settings()
    for name, distribution in space.distributions.items():
        for value in _extremes(distribution):
            with_values(run, {**samples[0], name: value}).settings()


def _check_names(space: Space, run: RunSpec, names: Set[str]) -> None:
    if "n_timesteps" in names:
        raise ConfigError(
            f"the search space {space.name!r} varies n_timesteps, but trials are compared at equal "
            "numbers of steps; leave it out and give -n"
        )
    fixed = {**{name: getattr(run, name) for name in OPTIONS}, **run.hyperparams}
    for name in sorted(names):
        if fixed.get(name) is not None:
            raise ConfigError(
                f"the search space {space.name!r} varies {name}, which is also fixed to "
                f"{fixed[name]!r}; drop one of the two"
            )
    method = run.settings().method
    if method == DENSE:
        absent = (OF_SPARSE_POLICIES | OF_METHODS) & names
    else:
        absent = (OF_METHODS & names) - Methods.parse(method).options
    if absent:
        raise ConfigError(
            f"method {method!r} has no {', '.join(sorted(absent))}, which the search space "
            f"{space.name!r} varies; leave it out there, or tune another method"
        )


def _extremes(distribution: BaseDistribution) -> tuple[Any, ...]:
    if isinstance(distribution, CategoricalDistribution):
        return distribution.choices
    assert isinstance(distribution, (FloatDistribution, IntDistribution))
    return distribution.low, distribution.high
