"""The figures, one per file; importing this package registers them all."""

from sb3_sparse.report.figures import (  # noqa: F401
    curves,
    findings,
    flops,
    improvement,
    iqm,
    masks,
    noise,
    parameters,
    profiles,
    ratio,
    seconds,
    sensitivity,
    snr,
)
from sb3_sparse.report.figures.base import FIGURES, check_figures, draw
from sb3_sparse.report.results import NotEnoughData

__all__ = ["FIGURES", "NotEnoughData", "check_figures", "draw"]
