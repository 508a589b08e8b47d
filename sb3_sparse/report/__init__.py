"""Reports on runs: figures, tables and verdicts, out of run folders alone."""

from sb3_sparse.report.data import LeftOut, RunData, read_runs
from sb3_sparse.report.figures import FIGURES
from sb3_sparse.report.study import Study
from sb3_sparse.report.verdicts import FINDINGS, Verdict, verdicts
from sb3_sparse.report.write import write_report

__all__ = [
    "FIGURES",
    "FINDINGS",
    "LeftOut",
    "RunData",
    "Study",
    "Verdict",
    "read_runs",
    "verdicts",
    "write_report",
]
