"""How much each hyperparameter decides which trials are the best."""

from __future__ import annotations

import warnings

from sb3_sparse.pages.backend import PercentFormatter
from sb3_sparse.tuning.backend import optuna
from sb3_sparse.tuning.figures.base import BEST, Picture, panels
from sb3_sparse.tuning.search import Search
from sb3_sparse.tuning.values import spelled, varied

LEAST = 30
BAR = 0.36  # inches
TITLE = "Importance of each hyperparameter"


def importances(search: Search) -> Picture:
    """Draw importances, if there are trials enough for them to mean something."""
    count, names = len(search.status().complete), varied(search)
    if count < LEAST:
        text = f"Importances need {LEAST} completed trials; this search has {count}."
        return Picture("importances", TITLE, text, None)
    if len(names) < 2:
        text = "Importances compare hyperparameters; this search varies only one."
        return Picture("importances", TITLE, text, None)
    evaluator = optuna.importance.PedAnovaImportanceEvaluator()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = optuna.importance.get_param_importances(
            search.study, evaluator=evaluator, params=list(names)
        )
    shares = dict(sorted(found.items(), key=lambda item: item[1]))
    figure, (axes,) = panels(1, height=BAR * len(shares) + 0.7)
    bars = axes.barh([spelled(name) for name in shares], list(shares.values()), color=BEST)
    axes.bar_label(bars, [f"{100 * share:.0f} %" for share in shares.values()], padding=4)
    axes.xaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    axes.set(xlim=(0, 1))
    axes.grid(visible=False, axis="y")
    text = (
        "How much each value decides whether a trial is among the best tenth, by PED-ANOVA "
        "(arXiv:2304.10255) over the completed trials; shares of all."
    )
    said = [f" Optuna says: {w.message}" for w in caught if w.category is UserWarning]
    return Picture("importances", TITLE, text + "".join(said), figure)
