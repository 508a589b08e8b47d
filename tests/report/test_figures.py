"""What holds for every figure, on the axes that are drawn, and numbers worked out by hand."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.text import Text
from scipy import stats

from sb3_sparse.errors import ConfigError
from sb3_sparse.pages.lines import BAND, BOLD, SEED
from sb3_sparse.pages.plot import TEXT, styled
from sb3_sparse.report import FIGURES, Results, judge, read_runs
from sb3_sparse.report.figures import draw
from sb3_sparse.report.figures.findings import REGION, forest
from sb3_sparse.report.methods import LOOKS, OTHERS
from sb3_sparse.report.normalisation import possible_returns
from sb3_sparse.report.results import NotEnoughData
from sb3_sparse.report.statistics import chances, mean_difference

ARROWS = set("<>^v1234") | set(range(12))
IN_ROWS = set(FIGURES) - {"findings", "masks"}
ALL = ["dense", "equal", "prune", "static", "set", "rigl"]


def results_of(folders, varies=None):
    runs, out = read_runs(folders)
    assert not out
    return Results(tuple(runs), varies)


@pytest.fixture(scope="module")
def drawn(study_folders):
    """Every figure of three seeds of six methods."""
    results = results_of(study_folders, "weight_decay")
    return {name: draw(name, results) for name in FIGURES}


def many(folders, count, labels=ALL, levels=(0.8, 0.95), env_id="CartPole-v1", least=380.0):
    """Curves that reach the greatest possible return, of so many seeds."""
    rng = np.random.default_rng(0)
    for seed in range(count):
        for label in labels:
            for level in (0.0,) if label == "dense" else levels:
                dense = label in ("dense", "equal")
                scores = list(np.clip(rng.normal(least + 100, 150, 10), 0, 500))
                folders.add(
                    "dense" if dense else label, None if dense else level, seed, scores,
                    env_id=env_id, match=level if label == "equal" else None,
                    noise={0.0: scores[-1], 1.0: scores[0], 2.0: scores[1]},
                )  # fmt: skip
    return results_of(folders.made)


def marked(axes, gid):
    return [artist for artist in axes.get_children() if artist.get_gid() == gid]


def bold(axes):
    return [line for line in axes.get_lines() if line.get_linewidth() == BOLD]


def rows_of(drawing):
    """The panels of each row, by their grid."""
    rows = {}
    for axes in drawing.figure.axes:
        rows.setdefault(axes.get_subplotspec().rowspan.start, []).append(axes)
    return rows.values()


@pytest.mark.parametrize("name", list(FIGURES))
def test_a_figure_has_at_most_four_lines_a_panel_one_legend_and_no_arrows(drawn, name):
    figure = drawn[name].figure
    assert len(figure.legends) <= 1
    for axes in figure.axes:
        assert len(bold(axes)) <= 4
        assert axes.get_legend() is None
        assert not {line.get_marker() for line in axes.get_lines()} & ARROWS


@pytest.mark.parametrize("name", list(FIGURES))
def test_three_seeds_have_no_band(drawn, name):
    for axes in drawn[name].figure.axes:
        assert not marked(axes, BAND)


@pytest.mark.parametrize("name", sorted(IN_ROWS))
def test_panels_of_a_row_share_their_axes_and_labels_stand_outside(drawn, name):
    drawing = drawn[name]
    for row in rows_of(drawing):
        if not row[0].get_title().endswith(("-v1", "-v5")):  # other tasks have other returns
            assert len({axes.get_ylim() for axes in row}) == 1
        assert not any(axes.get_xlabel() for axes in row)
    texts = [text.get_text() for text in drawing.figure.findobj(Text)]
    assert texts.count(drawing.figure.get_supxlabel()) == 1
    assert not [text for text in texts if "task(s)" in text or "strat" in text or "famil" in text]


@pytest.mark.parametrize("name", list(FIGURES))
def test_ticks_of_an_axis_are_alike_since_matplotlib_measures_one_of_them_by_chance(drawn, name):
    for one in drawn[name].figure.axes:
        for axis in (one.xaxis, one.yaxis):
            seen = {
                (tick.tick1line.get_visible(), tick.tick2line.get_visible())
                for tick in axis.get_major_ticks()
            }
            assert len(seen) <= 1


@pytest.mark.parametrize("name", list(FIGURES))
def test_texts_are_large_enough_and_do_not_overlap(drawn, name):
    figure = drawn[name].figure
    with styled():
        figure.draw_without_rendering()
    assert figure.get_figwidth() < 14.5
    texts = texts_of(figure)
    assert min(text.get_fontsize() for text in texts) >= TEXT
    boxes = [(text.get_text(), text.get_window_extent().padded(-1.5)) for text in texts]
    width, height = figure.canvas.get_width_height()
    for text, box in boxes:
        assert -2 <= box.x0 <= box.x1 <= width + 2, text
        assert -2 <= box.y0 <= box.y1 <= height + 2, text
    overlaps = [(a, b) for (a, one), (b, other) in combinations(boxes, 2) if one.overlaps(other)]
    assert overlaps == []


def texts_of(figure):
    """The texts that a reader sees, of ticks those within the limits."""
    found = [*figure.texts, *(text for one in figure.legends for text in one.get_texts())]
    panels = [axes for axes in figure.axes if axes.get_visible()]
    for axes in [*panels, *(child for one in panels for child in one.child_axes)]:
        found += [axes.title, *axes.texts, axes.xaxis.label, axes.yaxis.label]
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            for tick in axis.get_major_ticks() if axis.get_visible() else ():
                if low <= tick.get_loc() <= high:
                    found += [tick.label1, tick.label2]
    return list(
        {id(text): text for text in found if text.get_text() and text.get_visible()}.values()
    )


@pytest.mark.parametrize("name", ["curves", "parameters", "noise", "iqm", "improvement"])
def test_below_five_seeds_each_is_drawn_and_from_five_on_a_band(folders, tmp_path, name):
    labels = ["dense", "equal", "static", "rigl"]
    few = draw(name, many(folders, 4, labels))
    more = draw(name, many(type(folders)(tmp_path / "more"), 5, labels))
    assert not any(marked(axes, BAND) for axes in few.figure.axes)
    assert all(marked(axes, BAND) for axes in more.figure.axes)
    assert not any(marked(axes, SEED) for axes in more.figure.axes)
    if name != "iqm":
        assert all(len(marked(axes, SEED)) >= 4 for axes in few.figure.axes)


def test_an_interval_beside_none_is_a_bar_as_a_band_has_no_area_there(folders):
    for seed in range(5):
        folders.add("rigl", 0.9, seed, 300.0 + seed)
        folders.add("dense", None, seed, 200.0 + seed)
    folders.add("rigl", 0.5, 0, 100.0)
    (axes,) = draw("parameters", results_of(folders.made)).figure.axes
    bars = [one for one in marked(axes, BAND) if isinstance(one, LineCollection)]
    found = sorted(tuple(one.get_segments()[0][:, 1]) for one in bars)
    half = stats.t.ppf(0.975, 4) * np.std(range(5), ddof=1) / np.sqrt(5)
    assert found == [
        pytest.approx((202.0 - half, 202.0 + half)),
        pytest.approx((302.0 - half, 302.0 + half)),
    ]


@pytest.mark.parametrize("name", ["curves", "parameters", "noise"])
def test_bands_end_at_the_returns_that_are_possible_and_the_numbers_do_not(folders, name):
    drawing = draw(name, many(folders, 5))
    for axes in drawing.figure.axes:
        for band in marked(axes, BAND):
            low, high = band.get_datalim(axes.transData).intervaly
            assert -1e-9 <= low <= high <= 500 + 1e-9
        low, high = axes.get_ylim()
        assert -30 <= low < high <= 530
    column = drawing.heads.index("high")
    assert max(row[column] for row in drawing.rows) > 500


def test_the_axis_of_noise_has_its_unit(folders):
    def labels():
        return draw("noise", results_of(folders.made)).figure.get_supxlabel()

    folders.add("rigl", 0.9, noise={0.0: 2.0, 1.0: 1.0})
    assert labels() == "noise, in standard deviations of the observation"
    folders.add("rigl", 0.9, env_id="PongNoFrameskip-v4", noise={0.0: 2.0, 5.0: 1.0})
    assert labels() == "standard deviation of the noise"
    del folders.made[0]
    assert labels() == "standard deviation of the noise, grey levels"


def test_possible_returns_are_those_of_the_tasks():
    assert possible_returns("CartPole-v1") == (0, 500)
    assert possible_returns("Acrobot-v1") == (-500, 0)
    assert possible_returns("MountainCar-v0") == (-200, 0)
    low, high = possible_returns("Pendulum-v1")
    assert low == pytest.approx(-200 * (np.pi**2 + 0.1 * 8**2 + 0.001 * 2**2), abs=0.1)
    assert high == 0
    assert possible_returns("HalfCheetah-v5") == (-np.inf, np.inf)


def test_many_methods_have_a_panel_each_beside_dense_in_grey(folders):
    figure = draw("curves", many(folders, 2)).figure
    assert [axes.get_title() for axes in figure.axes[:5]] == [
        "Dense,\nequal parameters", "Pruning", "Static", "SET", "RigL",
    ]  # fmt: skip
    assert len(figure.axes) == 10
    for axes in figure.axes:
        assert [line.get_color() for line in bold(axes)][0] == LOOKS["dense"].color
        assert len(bold(axes)) == 2
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["Dense", "one seed"]


def test_few_methods_share_a_panel_for_each_sparsity(folders):
    figure = draw("curves", many(folders, 2, ["dense", "equal", "set", "rigl"])).figure
    assert [axes.get_title() for axes in figure.axes] == ["80 % sparse", "95 % sparse"]
    assert [len(bold(axes)) for axes in figure.axes] == [4, 4]
    assert figure.get_suptitle() == "DQN on CartPole-v1, 2 seeds"


TALLEST = 10.4  # inches: 1,000 pixels of a screen


def test_eight_rows_of_panels_fit_a_screen_and_tasks_are_named_at_the_left(folders):
    levels = (0.5, 0.8, 0.9, 0.95)
    many(folders, 2, levels=levels)
    results = many(folders, 2, levels=levels, env_id="Acrobot-v1")
    figure = draw("curves", results).figure
    with styled():
        figure.draw_without_rendering()
    assert len(figure.axes) == 8 * 5
    assert figure.get_figheight() <= TALLEST
    names = [text for axes in figure.axes for text in axes.texts]
    assert [text.get_text() for text in names] == ["Acrobot-v1", "CartPole-v1"]
    first, second = (text.get_window_extent() for text in names)
    assert first.x1 < figure.axes[0].yaxis.label.get_window_extent().x0
    assert figure.axes[15].bbox.y0 < first.y0 < first.y1 < figure.axes[0].bbox.y1
    assert figure.axes[35].bbox.y0 < second.y0 < second.y1 < figure.axes[20].bbox.y1


def test_more_rows_than_a_screen_has_show_one_sparsity_of_each_task(folders):
    for env_id in ("Acrobot-v1", "CartPole-v1"):
        results = many(folders, 1, levels=(0.5, 0.8, 0.9, 0.95, 0.99), env_id=env_id)
    drawing = draw("curves", results)
    assert len(drawing.figure.axes) == 2 * 5
    assert drawing.figure.get_suptitle() == "DQN on classic control, 90 % sparse, 1 seed"
    assert [axes.get_ylabel() for axes in drawing.figure.axes[::5]] == ["Acrobot-v1", "CartPole-v1"]
    assert {row[2] for row in drawing.rows} == {0.0, 0.5, 0.8, 0.9, 0.95, 0.99}
    assert drawing.remarks == [
        "all sparsities of a task but one, as there are too many; the CSV has their numbers"
    ]


def test_a_cell_without_runs_says_so(folders):
    many(folders, 1, ["dense", "prune", "static", "set", "rigl"], (0.8,))
    many(folders, 1, ["set", "static", "equal"], (0.95,))
    figure = draw("curves", results_of(folders.made)).figure
    said = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert said.count("no runs") == 3  # equal at 80 %, pruning and RigL at 95 %


def test_sparsities_stand_above_their_parameters(folders):
    results = many(folders, 2, ["dense", "rigl"], (0.5, 0.75, 0.875))
    (axes,) = draw("parameters", results).figure.axes
    (above,) = axes.child_axes
    sizes = [64 * 64 // part + 10 for part in (8, 4, 2, 1)]
    assert list(above.get_xticks()) == sizes
    assert [text.get_text() for text in above.get_xticklabels()] == ["87.5", "75", "50", "0"]


def test_seeds_of_the_dense_network_stand_at_its_size_and_its_mean_crosses_the_panel(folders):
    results = many(folders, 2, ["dense", "rigl"], (0.5, 0.75))
    scores = sorted(run.score for run in results.runs if run.label == "dense")
    (axes,) = draw("parameters", results).figure.axes
    grey = [line for line in axes.get_lines() if line.get_color() == LOOKS["dense"].color]
    (dots,) = [line for line in grey if line.get_gid() == SEED]
    assert sorted(dots.get_ydata()) == pytest.approx(scores)
    assert list(dots.get_xdata()) == [64 * 64 + 10] * 2
    (across,) = [line for line in grey if list(line.get_xdata()) == [0, 1]]
    assert list(across.get_ydata()) == pytest.approx([np.mean(scores)] * 2)


def test_lines_whose_ends_stand_apart_are_named_there_instead_of_in_a_legend(folders):
    for level in (0.5, 0.9):
        folders.add("static", level, policy={"distribution": "erk"})
        folders.add("static", level, share=0.5, policy={"distribution": "uniform"})
    results = results_of(folders.made)
    for place, run in enumerate(results.runs):
        run.record["total"]["flops"] = (place + 1) * 1500
    figure = draw("flops", results).figure
    assert not figure.legends
    assert {text.get_text() for text in figure.axes[-1].texts} == {"ERK", "uniform"}


def test_only_sparse_layers_have_masks_and_methods_stand_side_by_side(folders):
    for label in ("rigl", "static"):
        folders.add(label, 0.9, model=True, share=0.34, env_id="Hopper-v5", algo="sac")
        folder = folders.made[-1]
        text = (folder / "sparsity.json").read_text()
        # The critic's layer is dense, e.g. the first by ERK.
        size = 64 * 64
        nnz = round(size * (1 - 0.9) * 0.66)
        (folder / "sparsity.json").write_text(text.replace(f'"nnz": {nnz},', f'"nnz": {size},'))
    drawing = draw("masks", results_of(folders.made))
    assert [axes.get_title() for axes in drawing.figure.axes] == [
        "Static\n3.4 % active", "RigL\n3.4 % active",
    ]  # fmt: skip
    assert {row[3] for row in drawing.rows} == {"actor.0"}


def test_no_marker_of_a_method_is_an_arrow():
    assert not {look.marker for look in [*LOOKS.values(), *OTHERS]} & ARROWS


def test_a_difference_of_means_has_welchs_interval():
    x, y = [1.0, 2.0, 4.0, 7.0], [0.5, 0.9, 1.0]
    found = mean_difference(x, y)
    wanted = stats.ttest_ind(x, y, equal_var=False).confidence_interval(0.95)
    assert (found.value, found.seeds) == (pytest.approx(2.7), 3)
    assert (found.low, found.high) == pytest.approx((wanted.low, wanted.high))
    assert mean_difference([2.0, 2.0], [1.0, 1.0]).low == 1.0
    single = mean_difference([2.0], [1.0, 3.0])
    assert single.value == 0.0
    assert np.isnan(single.low)


def test_the_chance_of_a_run_is_the_share_that_it_beats():
    found = chances(np.array([[2.0, 1.0], [3.0, 0.0]]), np.array([[1.0, 1.0], [3.0, 0.5]]))
    # 2 beats 1 and not 3, 1 ties with 1 and beats 0.5; 3 beats 1 and ties, 0 beats none.
    assert found.tolist() == [(0.5 + 0.75) / 2, (0.75 + 0.0) / 2]


@pytest.fixture
def compared(folders):
    for seed, score in enumerate((300.0, 310.0, 320.0)):
        folders.add("rigl", 0.9, seed, score + 150)
        folders.add("dense", None, seed, score, match=0.9)
        folders.add("rigl", 0.95, seed, score + 60)
    folders.add("dense", None, 0, 300.0, match=0.95)
    return results_of(folders.made)


def test_findings_show_the_verdicts_and_each_cell_compared(compared):
    verdicts = judge(compared)
    (verdict,) = [one for one in verdicts if one.finding.key == "equal-parameters"]
    with styled():
        drawing = forest(compared, verdicts)
    (axes,) = drawing.figure.axes
    assert axes.get_title(loc="left") == verdict.finding.text
    rows = [dict(zip(drawing.heads, row, strict=True)) for row in drawing.rows]
    cells = ["all", "CartPole-v1 at 90 %", "CartPole-v1 at 95 %"]
    assert [row["compared"] for row in rows] == cells
    first = rows[0]
    assert (first["effect"], first["low"], first["high"]) == (
        verdict.effect, verdict.low, verdict.high,
    )  # fmt: skip
    assert first["verdict"] == verdict.verdict == "supported"
    assert rows[1]["effect"] == pytest.approx(150 / 453)  # CartPole's scale: 22 to 475
    half = stats.t.ppf(0.975, 4) * np.sqrt(2 * 100 / 3) / 453
    assert rows[1]["low"] == pytest.approx(150 / 453 - half)
    assert [row["seeds"] for row in rows] == [3, 3, 3]
    assert [row["seeds of the other side"] for row in rows] == [3, 3, 1]
    asides = [text.get_text() for text in axes.child_axes[0].get_yticklabels()]
    assert asides[0].startswith("3 + 3 seeds  +0.33 [")
    assert asides[0].endswith("supported")
    assert asides[2] == "3 + 1 seeds  +0.15"
    (region,) = marked(axes, REGION)
    assert region.get_datalim(axes.transData).x0 == 0.0


def test_one_finding_can_be_drawn_alone_and_an_unknown_one_is_refused(compared):
    verdicts = judge(compared)
    with styled():
        assert forest(compared, verdicts, ["equal-parameters"]).rows[0][0] == "equal-parameters"
        with pytest.raises(NotEnoughData, match="no RigL run beside a SET run"):
            forest(compared, verdicts, ["rigl-set"])
        with pytest.raises(ConfigError, match="unknown finding 'rigl-sets'"):
            forest(compared, verdicts, ["rigl-sets"])


def test_a_margin_is_shaded_in_units_of_the_effect(folders):
    for seed in range(3):
        folders.add("rigl", 0.9, seed, 400.0 + seed)
        folders.add("set", 0.9, seed, 400.0 + seed)
    results = results_of(folders.made)
    with styled():
        (axes,) = forest(results, judge(results), ["rigl-set"]).figure.axes
    (region,) = marked(axes, REGION)
    box = region.get_datalim(axes.transData)
    margin = 0.1 * (401.0 - 22.0) / 453.0  # a tenth of SET's IQM
    assert (box.x0, box.x1) == pytest.approx((-margin, margin))
