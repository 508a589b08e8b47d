"""The figures of a search: the best trial in colour, all others grey, over environment steps."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.colors import to_hex
from tuning_support import choices, searched, small_run

from sb3_sparse.tuning import Space, open_storage
from sb3_sparse.tuning.backend import TrialState, optuna
from sb3_sparse.tuning.evaluations import curve_of, evaluations_of
from sb3_sparse.tuning.figures import pictures
from sb3_sparse.tuning.figures.base import BEST, GREY
from sb3_sparse.tuning.figures.importances import importances
from sb3_sparse.tuning.search import Search

DECAYS, INTERVALS = [0.0, 1e-6, 1e-4], [100, 1000]
Float, Int = optuna.distributions.FloatDistribution, optuna.distributions.IntDistribution


@pytest.fixture
def storage(tmp_path):
    return open_storage(tmp_path / "tune" / "journal.log")


def score(values) -> float:
    """70 at its best, for a weight decay of 1e-6 and an interval of 1000."""
    return 50.0 - 1e5 * abs(values["weight_decay"] - 1e-6) + values["update_interval"] / 50


def rising(values, seed) -> list[float]:
    """Six evaluations that end at the score, of the second seed 10 higher; some trials stop."""
    planned = 2 if values["weight_decay"] == 1e-4 and seed == 0 else 6
    return [score(values) - 5 + place + 10 * seed for place in range(planned)]


@pytest.fixture
def search(storage):
    space = choices(weight_decay=DECAYS, update_interval=INTERVALS)
    return Search(searched(storage, "grid", rising, small_run(), space, seeds=2))


def drawn(search, name):
    return next(one for one in pictures(search) if one.name == name)


def by_color(lines):
    """Lines in the colour of the best, and grey ones; there are no others."""
    colors = [to_hex(line.get_color()) for line in lines]
    assert set(colors) <= {BEST.lower(), GREY}
    best = [line for line, color in zip(lines, colors, strict=True) if color == BEST.lower()]
    return best, [line for line, color in zip(lines, colors, strict=True) if color == GREY]


def test_returns_are_found_again_in_what_a_trial_reported():
    trial = optuna.trial.create_trial(
        state=TrialState.PRUNED,
        user_attrs={"scores": [6.0]},
        intermediate_values={1: 1.0, 2: 4.0, 3: 6.0, 4: (6 + 2) / 2, 5: (6 + 8) / 2},
    )
    np.testing.assert_allclose(evaluations_of(trial, 3), [[1, 4, 6], [2, 8, np.nan]])
    assert curve_of(trial, 3).tolist() == [1, 4, 6]  # of the seed that came to the end
    early = optuna.trial.create_trial(state=TrialState.PRUNED, intermediate_values={1: 3.0, 2: 5.0})
    assert curve_of(early, 3).tolist() == [3, 5]
    assert curve_of(optuna.trial.create_trial(state=TrialState.PRUNED), 3).tolist() == []


def test_evaluations_are_means_over_seeds_at_environment_steps(search):
    best = search.status().best
    assert best.params == {"weight_decay": 1e-6, "update_interval": 1000}
    (axes,) = drawn(search, "evaluations").figure.axes
    (line,), grey = by_color(axes.get_lines())
    assert line.get_xdata().tolist() == [100, 200, 300, 400, 500, 600]
    assert line.get_ydata().tolist() == [70, 71, 72, 73, 74, 75]  # 65 to 70, and 10 more
    assert line.get_linewidth() > max(one.get_linewidth() for one in grey)
    assert sorted(len(one.get_xdata()) for one in grey) == [2, 2, 6, 6, 6]  # two were pruned
    assert axes.get_title(loc="right") == f"best: trial {best.number}"


def test_the_history_has_every_trial_and_the_best_so_far(search):
    status = search.status()
    (axes,) = drawn(search, "history").figure.axes
    (line,), grey = by_color(axes.get_lines())
    assert grey == []
    scores = {one.number: one.values[0] for one in status.complete}
    numbers = sorted(scores)
    so_far = [max(scores[n] for n in numbers if n <= last) for last in numbers]
    assert line.get_xdata().tolist() == [*numbers, 5]
    assert line.get_ydata().tolist() == [*so_far, 75]  # 70 and 80 by seed
    complete, pruned, best = [one.get_offsets().tolist() for one in axes.collections]
    assert complete == [[n, scores[n]] for n in numbers]
    last = {100: 38.1, 1000: 56.1}  # the second evaluation: 4 below the score
    stopped = [one for one in status.done if one.state == TrialState.PRUNED]
    expected = [[one.number, last[one.params["update_interval"]]] for one in stopped]
    np.testing.assert_allclose(pruned, expected)
    assert best == [[status.best.number, 75.0]]


def test_a_grid_of_two_is_a_heat_map_with_its_numbers(search):
    picture = drawn(search, "values")
    assert picture.title == "Scores by weight decay and update interval"
    (axes,) = picture.figure.axes
    (image,) = axes.get_images()
    # rows: decays; columns: intervals; the mean of both seeds is 5 above the score
    expected = [[56.9, 74.9], [57.0, 75.0], [np.nan, np.nan]]
    np.testing.assert_allclose(np.ma.filled(image.get_array(), np.nan), expected)
    numbers = {text.get_text(): text.get_fontweight() for text in axes.texts}
    assert numbers == {"56.9": "normal", "74.9": "normal", "57": "normal", "75": "bold"}
    assert [text.get_text() for text in axes.get_yticklabels()] == ["0", "1e-6", "1e-4"]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["100", "1k"]
    assert "Empty cells have no completed trial." in picture.caption


def test_a_grid_of_one_is_a_line_of_means_over_dots_of_seeds(storage):
    space = choices(drop_fraction=[0.5, 0.1, 0.3])
    study = searched(
        storage, "line", lambda v, seed: [10 * v["drop_fraction"] + seed] * 6, small_run(), space, 3
    )
    picture = drawn(Search(study), "values")
    (axes,) = picture.figure.axes
    (line,), _ = by_color(axes.get_lines())
    np.testing.assert_allclose(line.get_ydata(), [2, 4, 6])  # seeds 1, 2 and 3 for 0.1
    assert [text.get_text() for text in axes.get_xticklabels()] == ["0.1", "0.3", "0.5"]
    dots = np.concatenate([one.get_offsets() for one in axes.collections])
    np.testing.assert_allclose(dots[:, 1], [1, 2, 3, 3, 4, 5, 5, 6, 7])
    assert axes.get_images() == []


def test_choices_that_are_no_numbers_are_not_joined_by_a_line(storage):
    space = choices(distribution=["erk", "uniform"])
    study = searched(storage, "words", lambda *_: [1.0] * 6, small_run(), space)
    (axes,) = drawn(Search(study), "values").figure.axes
    (line,) = axes.get_lines()
    assert line.get_linestyle() == "None"


def test_ranges_are_slices_with_one_scale_of_scores(storage):
    space = Space(
        "ranges",
        {
            "weight_decay": Float(1e-7, 1e-2, log=True),
            "update_interval": Int(50, 10_000, log=True),
            "drop_fraction": Float(0.0, 0.5),
        },
    )
    study = searched(
        storage,
        "ranges",
        lambda values, _: [100 * values["drop_fraction"]] * 6,
        small_run(),
        space,
        trials=12,
        sampler="random",
    )
    search = Search(study)
    axes = drawn(search, "values").figure.axes
    labels = {one.get_xlabel(): one for one in axes}
    assert sorted(labels) == ["drop fraction", "update interval", "weight decay"]
    assert {one.get_xscale() for one in axes} == {"linear", "log"}
    assert [labels[name].get_xscale() for name in sorted(labels)] == ["linear", "log", "log"]
    assert len({one.get_ylim() for one in axes}) == 1
    low, high = labels["weight decay"].get_xlim()
    assert low < 1e-7 < 1e-2 < high
    best = search.status().best
    for name, one in labels.items():
        grey, chosen = one.collections
        assert len(grey.get_offsets()) == 12
        assert to_hex(grey.get_facecolor()[0]) == GREY
        value = best.params[name.replace(" ", "_")]
        np.testing.assert_allclose(chosen.get_offsets(), [[value, best.values[0]]])
        assert to_hex(chosen.get_facecolor()[0]) == BEST.lower()
        assert one.get_images() == []


def test_a_grid_of_three_is_slices_with_the_mean_of_each_choice(storage):
    space = choices(weight_decay=DECAYS, update_interval=INTERVALS, drop_fraction=[0.1, 0.5])
    study = searched(
        storage, "three", lambda v, _: [v["update_interval"] / 100] * 6, small_run(), space
    )
    axes = {one.get_xlabel(): one for one in drawn(Search(study), "values").figure.axes}
    assert axes.keys() == {"weight decay", "update interval", "drop fraction"}
    short = [one for one in axes["update interval"].collections if hasattr(one, "get_segments")]
    heights = [segment[0][1] for one in short for segment in one.get_segments()]
    assert sorted(heights) == [1.0, 10.0]
    assert all(one.get_images() == [] for one in axes.values())


def test_a_space_of_one_value_has_nothing_to_compare(storage):
    study = searched(storage, "one", lambda *_: [1.0] * 6, small_run(), choices(weight_decay=[0.0]))
    picture = drawn(Search(study), "values")
    assert (picture.figure, picture.caption) == (
        None, "No hyperparameter has more than one value."
    )  # fmt: skip


@pytest.mark.parametrize("count", [29, 30])
def test_importances_need_thirty_trials(storage, count):
    space = Space("two", {"weight_decay": Float(0.0, 1.0), "drop_fraction": Float(0.0, 0.5)})
    study = searched(
        storage,
        "two",
        lambda values, _: [100 * values["drop_fraction"]] * 6,
        small_run(),
        space,
        trials=count,
        sampler="random",
    )
    picture = importances(Search(study))
    if count == 29:
        assert picture.figure is None
        assert picture.caption == "Importances need 30 completed trials; this search has 29."
        return
    (axes,) = picture.figure.axes
    names = [text.get_text() for text in axes.get_yticklabels()]
    widths = dict(zip(names, (bar.get_width() for bar in axes.patches), strict=True))
    assert sum(widths.values()) == pytest.approx(1)
    assert names[-1] == "drop fraction"  # at the top; only it decides
    assert widths["drop fraction"] > 0.6
