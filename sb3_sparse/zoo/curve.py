"""The learning curve of a run, as a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sb3_sparse.intervals import Array
from sb3_sparse.pages.look import Look
from sb3_sparse.pages.plot import Drawing, Sheet, save_png, styled
from sb3_sparse.zoo.archive import Archived
from sb3_sparse.zoo.folder import RunFolder

CURVE = "curve.png"
HEADS = ("timesteps", "mean", "low", "high", "episodes")
LOOK = Look("#0072b2", "o", "-")


def curve(title: str, timesteps: Array, returns: Array) -> Drawing:
    """Draw the mean return of each evaluation, with a band of a standard deviation over episodes.

    :param timesteps: environment steps before each evaluation, shape ``[evaluations]``
    :param returns: episode returns, shape ``[evaluations, episodes]``
    """
    mean, spread = returns.mean(axis=1), returns.std(axis=1)
    spread = np.where(returns.shape[1] > 1, spread, np.nan)  # one episode has no band
    with styled():
        sheet = Sheet(HEADS, 1, band="standard deviation over episodes")
        (axes,) = sheet.axes
        steps = [int(step) for step in timesteps]
        ends = (mean, mean - spread, mean + spread)
        sheet.line(axes, [], steps, ends, [returns.shape[1]], LOOK, "")
        axes.set(title=title, xlabel="environment steps", ylabel="mean return")
        axes.ticklabel_format(axis="x", style="sci", scilimits=(-3, 4))
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
