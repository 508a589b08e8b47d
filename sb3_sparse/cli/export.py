"""``sb3-sparse export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from sb3_sparse.cli.common import Best, GymPackages, ModelAlgo, ModelEnv, Statistics, option, say
from sb3_sparse.errors import ConfigError
from sb3_sparse.export.formats import INT8, check_format, check_int8, check_outputs

RECORDED = 1000


class ExportCommand(TyperCommand):
    """Takes ``--int8`` alone and ``--int8 full``; any other word after it is the next argument."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Give ``--int8`` its value before the options are read."""
        words: list[str] = []
        alone = False
        for word in args:
            if alone:
                words[-1] = f"--int8={word if word in INT8 else INT8[0]}"
            if not (alone and word in INT8):
                words.append(word)
            alone = word == "--int8"
        if alone:
            words[-1] = f"--int8={INT8[0]}"
        return super().parse_args(ctx, words)


def export_command(
    model: Annotated[Path, typer.Argument(help="A run's folder, or a zip saved by SB3.")],
    out: Annotated[
        Path, typer.Argument(help="The file to write; its suffix may be left out.")
    ] = Path("policy"),
    to: Annotated[str, option("c, numpy, onnx or dense (a zip of stock SB3).", "--to")] = "c",
    vecnormalize: Statistics = None,
    int8: Annotated[
        str | None,
        typer.Option(
            "--int8",
            help="C only: weights as 8-bit numbers with a scale for each row (weights, also by "
            "--int8 alone); or linear layers without floats, too, for processors without a float "
            "unit (full).",
            metavar="[weights|full]",
            show_default=False,
        ),
    ] = None,
    with_value: Annotated[
        bool,
        option("Not for dense: also give the critic's estimate, V(s) or Q(s, a).", "--with-value"),
    ] = False,
    stochastic: Annotated[
        bool,
        option("Not for dense: also give mean and standard deviation, or logits.", "--stochastic"),
    ] = False,
    best: Best = False,
    env: ModelEnv = None,
    gym_packages: GymPackages = None,
    algo: ModelAlgo = None,
    force: Annotated[
        bool, option("Write the policy even if it does not act as the model.", "--force")
    ] = False,
) -> None:
    """Write a policy as C, NumPy, ONNX or a dense zip, and check that it acts the same.

    The check uses random observations, and recorded ones if the environment is known.
    """
    check_format(to)
    check_int8(int8, to)
    check_outputs(to, with_value, stochastic, int8)
    from sb3_sparse.export import export_policy, record_observations
    from sb3_sparse.export.write import main_file
    from sb3_sparse.zoo.saved import SavedModel

    saved = SavedModel.find(
        model,
        best=best,
        algo=algo,
        env_id=env,
        vecnormalize=vecnormalize,
        gym_packages=gym_packages or [],
    )
    if to == "dense" and main_file(out, ".zip").resolve() == saved.path.resolve():
        raise ConfigError(f"{saved.path} would be overwritten by its own export; give another name")
    loaded = saved.load()
    observations = envs = None
    if saved.env_id is not None:
        envs = saved.evaluation_envs(RECORDED, 0)
    try:
        if envs is not None:
            observations = record_observations(loaded, envs, RECORDED)
            if int8 == "full":
                say("Both policies play 20 episodes or more; with images, this takes minutes ...")
        report = export_policy(
            loaded,
            out,
            to,
            vecnormalize=saved.vecnormalize,
            observations=observations,
            int8=int8 or False,
            with_value=with_value,
            stochastic=stochastic,
            eval_env=envs if int8 == "full" else None,
            force=force,
        )
    finally:
        if envs is not None:
            envs.close()
    say(report)
    if observations is None:
        say("note: no observations were recorded; --env ID compares the policies on an environment")
