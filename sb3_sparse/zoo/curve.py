"""The learning curve of a run, as a picture."""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np

from sb3_sparse.intervals import Array
from sb3_sparse.pages.backend import EngFormatter, MaxNLocator
from sb3_sparse.pages.look import Look
from sb3_sparse.pages.names import METHODS
from sb3_sparse.pages.numbers import counted
from sb3_sparse.pages.plot import Drawing, Sheet, save_png, styled
from sb3_sparse.zoo.archive import Archived
from sb3_sparse.zoo.configs import DENSE
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.spec import RunSpec

CURVE = "curve.png"
HEADS = ("timesteps", "mean", "low", "high", "episodes")
LOOK = Look("#362682", "o", "-")
WIDE, LETTERS = 4.8, 42  # inches, and the letters of a title's line that fit


def what_was_trained(spec: RunSpec, method: str, sparsity: float) -> str:
    """Say what a run trained, e.g. ``"SAC on Pendulum-v1, RigL at 90% sparsity"``."""
    name = METHODS.get(method, method)
    how = name if method == DENSE else f"{name} at {100 * sparsity:.3g}% sparsity"
    return f"{spec.algorithm.__name__} on {spec.env_id}, {how}"


def curve(title: str, timesteps: Array, returns: Array) -> Drawing:
    """Draw the mean return of each evaluation, with a band of a standard deviation over episodes.

    :param timesteps: environment steps before each evaluation, shape ``[evaluations]``
    :param returns: episode returns, shape ``[evaluations, episodes]``
    """
    mean, spread = returns.mean(axis=1), returns.std(axis=1)
    spread = np.where(returns.shape[1] > 1, spread, np.nan)  # one episode has no band
    with styled():
        band = f"standard deviation of {counted(returns.shape[1], 'episode')}"
        sheet = Sheet(HEADS, 1, width=WIDE, band=band)
        (axes,) = sheet.axes
        steps = [int(step) for step in timesteps]
        ends = (mean, mean - spread, mean + spread)
        sheet.line(axes, [], steps, ends, [returns.shape[1]], LOOK, "")
        axes.set(xlabel="environment steps", ylabel="mean return")
        axes.set_title(textwrap.fill(title, LETTERS), weight="bold")
        axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        return sheet.drawing()


def write_curve(folder: RunFolder, title: str) -> Path | None:
    """Write the learning curve of a run that has ended as ``curve.png`` into its folder.

    :return: the file; None if the run was too short for an evaluation during training
    :raises ConfigError: if the folder holds no run, or the run has not ended
    :raises CorruptStateError: if a file is damaged
    """
    if not folder.evaluations.is_file():
        return None
    run = Archived.of_folder(folder, "")
    path = folder.path / CURVE
    save_png(path, curve(title, run.timesteps, run.returns).figure)
    return path
