"""What the commands share: the console, and the options that say what is trained."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from sb3_sparse.errors import ConfigError

console = Console(highlight=False, markup=False)
"""Prints text as it is: names of folders may hold what Rich would take for markup."""
INTERRUPTED = 130
AS_CONFIG = "as the config"


def text(help: str, *names: str, shown: str | bool = True) -> Any:
    """An option."""
    return typer.Option(*names, help=help, show_default=shown)


Algo = Annotated[str, text("Algorithm: dqn, sac, ppo, td3, tqc, ...")]
Env = Annotated[str, text("Gymnasium environment id, or package:Id.")]
GymPackages = Annotated[
    list[str] | None,
    text(
        "Module that registers environments of your own; may be given again.",
        "--gym-packages",
        shown=False,
    ),
]
Method = Annotated[str | None, text("dense, prune, static, set or rigl.", shown="rigl")]
Sparsity = Annotated[float | None, text("Removed fraction, in [0, 1).", shown=AS_CONFIG)]
Distribution = Annotated[str | None, text("erk, er or uniform.", shown="erk")]
Steps = Annotated[int | None, text("Environment steps.", "--n-timesteps", "-n", shown=AS_CONFIG)]
Envs = Annotated[int | None, text("Environments side by side.", shown=AS_CONFIG)]
Hyperparams = Annotated[
    list[str] | None,
    text(
        "Anything else, as name:value ..., e.g. learning_rate:0.001 weight_decay:1e-4 "
        "update_interval:500.",
        "--hyperparams",
        "-params",
    ),
]
ConfFile = Annotated[
    str | None,
    text(
        "A YAML file in rl-zoo's form, or another shipped one by name (dqn_impala).",
        "--conf-file",
        "-conf",
    ),
]
EvalFreq = Annotated[int | None, text("Steps between two evaluations.", shown="as the paper")]
EvalEpisodes = Annotated[int | None, text("Episodes of an evaluation.", shown="as the paper")]
Best = Annotated[bool, text("Of a run's folder, the best policy instead of the last.", "--best")]
ModelAlgo = Annotated[str | None, text("Algorithm.", shown="as the run or the file")]
ModelEnv = Annotated[
    str | None, text("Gymnasium environment id, or package:Id.", shown="as the run")
]
Statistics = Annotated[
    Path | None,
    text("Statistics saved by VecNormalize.", "--vecnormalize", shown="those of the run"),
]
Launcher = Annotated[str, text("local: processes of this machine; ray: a Ray cluster.")]
Address = Annotated[str | None, text("Of the Ray cluster, e.g. auto.", shown="one of this machine")]
Device = Annotated[str, text("auto, cpu or cuda.")]
LogFolder = Annotated[Path, text("Where folders are made.", "--log-folder", "-f")]


def print_score(what: str, mean: float, std: float, path: Path) -> None:
    """A line on a policy's return."""
    score = (f"{mean:.1f} ± {std:.1f}", "bold")
    console.print(Text.assemble(f"{what:<13} ", score, f"  {path}"), soft_wrap=True)


def values_and_packages(
    extra: list[str], hyperparams: list[str] | None, gym_packages: list[str] | None
) -> tuple[list[str], list[str]]:
    """What follows ``--hyperparams`` and ``--gym-packages``, which both take several words.

    :param extra: words that no option has taken
    :raises ConfigError: if one belongs to neither
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
