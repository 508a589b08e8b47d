"""``sb3-sparse tune`` and ``sb3-sparse tune report``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from sb3_sparse.cli.common import (
    INTERRUPTED,
    Address,
    Algo,
    ConfFile,
    Device,
    Distribution,
    Env,
    Envs,
    EvalEpisodes,
    EvalFreq,
    GymPackages,
    Hyperparams,
    Launcher,
    LogFolder,
    Method,
    Sparsity,
    Steps,
    console,
    option,
    run_spec,
    say,
)
from sb3_sparse.cli.progress.tune import TuningProgress, values_in_words
from sb3_sparse.errors import command
from sb3_sparse.launch import launcher_named
from sb3_sparse.tuning.choices import check_names

if TYPE_CHECKING:
    from sb3_sparse.tuning import Tuned
    from sb3_sparse.zoo.spec import RunSpec

SEARCH = "search"


class _SearchByDefault(TyperGroup):
    """``tune ...`` is ``tune search ...`` unless another command is named."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(
            ctx, args if args and args[0] in self.commands else [SEARCH, *args]
        )


tuning = typer.Typer(cls=_SearchByDefault)
Storage = Annotated[
    str | None,
    option(
        "A journal file, or a database: postgresql://user:password@host/database, sqlite:///file.db.",
        shown="tune/journal.log in the log folder",
    ),
]


@tuning.command(SEARCH, context_settings={"allow_extra_args": True})
def search(
    context: typer.Context,
    algo: Algo = "dqn",
    env: Env = "CartPole-v1",
    method: Method = None,
    sparsity: Sparsity = None,
    distribution: Distribution = None,
    space: Annotated[
        str, option("paper (its grid), wide (continuous), or a file of your own, .yml or .py.")
    ] = "paper",
    trials: Annotated[
        int | None,
        option("How many trials.", "--trials", "--n-trials", shown="a whole grid, else 100"),
    ] = None,
    seeds: Annotated[int, option("Runs per trial; the mean counts.")] = 1,
    sampler: Annotated[
        str | None, option("grid, tpe or random.", shown="grid if all is lists, else tpe")
    ] = None,
    pruner: Annotated[
        str | None,
        option("none, median, halving or hyperband.", shown="none for a grid, else median"),
    ] = None,
    workers: Annotated[int, option("Trials at once, each in a process with one thread.")] = 1,
    launcher: Launcher = "local",
    address: Address = None,
    storage: Storage = None,
    study_name: Annotated[
        str | None, option("Name of the search.", shown="made of algorithm, env, method, space")
    ] = None,
    write_into: Annotated[
        Path | None,
        option("A config, e.g. zoo_hparams/rigl/sac.yml, whose entry also gets the best values."),
    ] = None,
    seed: Annotated[int, option("First seed of every trial, and the sampler's.")] = 0,
    n_timesteps: Steps = None,
    n_envs: Envs = None,
    hyperparams: Hyperparams = None,
    conf_file: ConfFile = None,
    gym_packages: GymPackages = None,
    eval_freq: EvalFreq = None,
    eval_episodes: EvalEpisodes = None,
    device: Device = "auto",
    log_folder: LogFolder = Path("logs"),
) -> None:
    """Search hyperparameters with Optuna; `sb3-sparse tune report SEARCH` writes a page on it.

    The same command continues an interrupted search, and joins it on another machine.
    """
    check_names(space, sampler, pruner)
    chosen = launcher_named(launcher, address)
    run = run_spec(
        context,
        algo,
        env,
        hyperparams,
        gym_packages,
        method=method,
        sparsity=sparsity,
        distribution=distribution,
        seed=seed,
        n_timesteps=n_timesteps,
        n_envs=n_envs,
        conf_file=conf_file,
        eval_freq=eval_freq,
        eval_episodes=eval_episodes,
        device=device,
    )
    run.config_entry()  # a typo shows before torch is imported
    from sb3_sparse.tuning import tune
    from sb3_sparse.tuning.best import check_target, merge_best
    from sb3_sparse.tuning.search import Search

    if write_into is not None:
        check_target(run, write_into)
    progress = TuningProgress(console)
    try:
        tuned = tune(
            run,
            space,
            trials=trials,
            seeds=seeds,
            sampler=sampler,
            pruner=pruner,
            name=study_name,
            storage=storage,
            log_folder=log_folder,
            workers=workers,
            launcher=chosen,
            watch=progress,
        )
    except KeyboardInterrupt:
        progress.close()
        say("Interrupted. Finished trials are kept; the same command continues.")
        raise typer.Exit(INTERRUPTED) from None
    finally:
        progress.close()
    _print_outcome(run, tuned, storage, log_folder)
    if write_into is not None and tuned.best is not None:
        merge_best(Search(tuned.study), write_into)
        say(f"Merged into {write_into}")
    if not tuned.status.finished:
        raise typer.Exit(1)


def _print_outcome(run: RunSpec, tuned: Tuned, storage: str | None, log_folder: Path) -> None:
    from sb3_sparse.tuning.urls import shown_url

    status, name = tuned.status, tuned.study.study_name
    for worker, error in tuned.errors.items():
        say(f"{worker}: {error.strip().splitlines()[-1]}")
    done = f"{len(status.done)} of {status.planned} trials are done"
    if not tuned.began:
        say(f"The search {name} is finished: {done}. Nothing to do.")
    elif status.finished:
        say(f"Search {name}: {done}.")
    else:
        say(
            f"Search {name}: {done}, {len(status.failed)} failed; the logs of the workers are in "
            f"{tuned.folder}. The same command continues, and tries failed trials again."
        )
    if tuned.best is None or tuned.config is None:
        return
    best = tuned.best
    values = values_in_words(status.values_of(best))
    say(f"Best: {best.values[0]:.6g}, trial {best.number}: {values}")
    say("Train with these values, look at the search:")
    where = [] if storage is None else ["--storage", shown_url(storage)]
    where += [] if log_folder == Path("logs") else ["--log-folder", str(log_folder)]
    train = ["train", "--algo", run.algo, "--env", run.env_id, "--conf-file", tuned.config]
    for package in run.gym_packages:
        train += ["--gym-packages", package]
    say(command(*train))
    say(command("tune", "report", name, *where))


@tuning.command()
def report(
    searches: Annotated[list[str], typer.Argument(help="Names of searches.", metavar="SEARCH...")],
    storage: Storage = None,
    out: Annotated[
        Path | None, option("The page.", shown="report.html in the first search's folder")
    ] = None,
    log_folder: LogFolder = Path("logs"),
) -> None:
    """Write an HTML page on searches, and a CSV of their trials."""
    from sb3_sparse.tuning.report import report_by_name

    page = report_by_name(searches, storage, log_folder, out)
    say(f"Page: {page}")
    say(f"Trials: {page.with_suffix('.csv')}")
