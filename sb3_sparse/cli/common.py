"""Shared by the commands: the console, and the options that several of them have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from sb3_sparse.errors import ConfigError
from sb3_sparse.zoo.choice import chosen
from sb3_sparse.zoo.overrides import parse_overrides
from sb3_sparse.zoo.spec import RunSpec

console = Console(highlight=False, markup=False)
"""Prints text unchanged: names of folders may contain what Rich takes for markup."""
INTERRUPTED = 130
AS_CONFIG = "as the config"


def option(help: str, *names: str, shown: str | bool = True) -> Any:
    """Describe an option of a command.

    :param help: shown by ``--help``
    :param names: e.g. ``"--log-folder", "-f"``; by default the parameter's name
    :param shown: the default as ``--help`` shows it; True: its value, False: nothing
    """
    return typer.Option(*names, help=help, show_default=shown)


def say(text: object, style: str | None = None) -> None:
    """Print a line, however long, without wrapping it.

    :param style: one of Rich's, e.g. ``"bold"``
    """
    console.print(str(text), soft_wrap=True, style=style)


ALGO = "Algorithm: dqn, sac, ppo, td3, tqc, ..."
ENV = "Gymnasium environment id, or package:Id."
Algo = Annotated[str, option(ALGO)]
Env = Annotated[str, option(ENV)]
GymPackages = Annotated[
    list[str] | None,
    option(
        "Module that registers environments or algorithms of yours; may be given again.",
        "--gym-packages",
        shown=False,
    ),
]
Method = Annotated[
    str | None,
    option(
        "dense, prune, static, set, rigl, granet, critic=rigl (a method for each "
        "network), or a preset: mst, rlx2, simba.",
        shown="rigl",
    ),
]
Sparsity = Annotated[float | None, option("Removed fraction, in [0, 1).", shown=AS_CONFIG)]
Distribution = Annotated[str | None, option("erk, er or uniform.", shown="erk")]
Steps = Annotated[int | None, option("Environment steps.", "--n-timesteps", "-n", shown=AS_CONFIG)]
Envs = Annotated[int | None, option("Environments side by side.", shown=AS_CONFIG)]
Hyperparams = Annotated[
    list[str] | None,
    option(
        "Anything else, as name:value ..., e.g. learning_rate:0.001 weight_decay:1e-4 "
        "update_interval:500.",
        "--hyperparams",
        "-params",
    ),
]
ConfFile = Annotated[
    str | None,
    option(
        "A YAML file in rl-zoo's form, or another shipped one by name (dqn_impala).",
        "--conf-file",
        "-conf",
    ),
]
EvalFreq = Annotated[int | None, option("Steps between two evaluations.", shown="as the paper")]
EvalEpisodes = Annotated[int | None, option("Episodes of an evaluation.", shown="as the paper")]
Best = Annotated[
    bool, option("Take the best policy of a run's folder instead of the last.", "--best")
]
ModelAlgo = Annotated[str | None, option("Algorithm.", shown="as the run or the file")]
ModelEnv = Annotated[
    str | None, option("Gymnasium environment id, or package:Id.", shown="as the run")
]
Statistics = Annotated[
    Path | None,
    option("Statistics saved by VecNormalize.", "--vecnormalize", shown="those of the run"),
]
Launcher = Annotated[str, option("local: processes of this machine; ray: a Ray cluster.")]
Address = Annotated[
    str | None, option("Address of the Ray cluster, e.g. auto.", shown="one of this machine")
]
Device = Annotated[str, option("auto, cpu or cuda.")]
LogFolder = Annotated[Path, option("Where folders are made.", "--log-folder", "-f")]


def print_score(what: str, mean: float, std: float, path: Path) -> None:
    """Print a policy's return, and where the policy is."""
    score = (f"{mean:.1f} ± {std:.1f}", "bold")
    console.print(Text.assemble(f"{what:<13} ", score, f"  {path}"), soft_wrap=True)


def run_spec(
    context: typer.Context,
    algo: str | None,
    env: str | None,
    hyperparams: list[str] | None,
    gym_packages: list[str] | None,
    **options: Any,
) -> RunSpec:
    """Make the specification of a run from the options of a command.

    :param context: holds the words left over by all other options
    :param algo: algorithm; None: one that suits the environment
    :param env: environment; None: one that suits the algorithm
    :param options: further fields of the specification
    :raises ConfigError: if a word belongs to no option, or a value is not allowed
    """
    values, packages = _values_and_packages(context.args, hyperparams, gym_packages)
    algo, env = chosen(algo and algo.lower(), env, packages)
    return RunSpec(
        algo=algo,
        env_id=env,
        hyperparams=parse_overrides(values),
        gym_packages=tuple(packages),
        **options,
    )


def _values_and_packages(
    extra: list[str], hyperparams: list[str] | None, gym_packages: list[str] | None
) -> tuple[list[str], list[str]]:
    """Split the words after ``--hyperparams`` and ``--gym-packages``, which take several each.

    :param extra: the words left over by all other options
    :raises ConfigError: if a word belongs to neither option
    """
    values, packages = list(hyperparams or []), list(gym_packages or [])
    for word in extra:
        if values and (":" in word or not packages):
            values.append(word)
        elif packages and ":" not in word:
            packages.append(word)
        else:
            raise ConfigError(f"unexpected argument {word!r}; see --help")
    return values, packages
