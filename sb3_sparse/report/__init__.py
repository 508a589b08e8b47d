"""Reports on runs: figures, tables and verdicts, read from run folders."""

from sb3_sparse.report.data import LeftOut, RunData
from sb3_sparse.report.figures import FIGURES
from sb3_sparse.report.findings import FINDINGS
from sb3_sparse.report.reading import read_runs
from sb3_sparse.report.results import Results
from sb3_sparse.report.verdicts import Verdict, judge
from sb3_sparse.report.write import write_report

__all__ = [
    "FIGURES",
    "FINDINGS",
    "LeftOut",
    "RunData",
    "Results",
    "Verdict",
    "judge",
    "read_runs",
    "write_report",
]
