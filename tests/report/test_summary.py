"""What a report says first: sentences and tables of scores, of made-up runs."""

from __future__ import annotations

import pytest

from sb3_sparse.pages.table import Cell
from sb3_sparse.report import Results, read_runs
from sb3_sparse.report.summary import scores, sentences


def results(folders, varies=None):
    runs, out = read_runs(folders.made)
    assert not out
    return Results(tuple(runs), varies)


def add(folders, label, level, values, **more):
    method = "dense" if label in ("dense", "equal") else label
    for seed, value in enumerate(values):
        folders.add(
            method, None if method == "dense" else level, seed, value,
            match=level if label == "equal" else None, **more,
        )  # fmt: skip


def test_the_first_sentence_tells_what_the_best_sparse_method_scores(folders):
    """Student's t of 2 degrees of freedom is 4.303; 300, 310, 320: 310 +- 4.303 * 10 / sqrt(3)."""
    add(folders, "dense", None, [200.0, 210.0, 220.0])
    add(folders, "equal", 0.9, [100.0, 110.0, 120.0])
    add(folders, "set", 0.9, [300.0, 310.0, 320.0])
    add(folders, "rigl", 0.9, [290.0, 290.0, 290.0])
    add(folders, "rigl", 0.99, [400.0, 400.0, 400.0])
    assert sentences(results(folders)) == [
        "CartPole-v1 at 90 %: SET 310 [290; 330], the highest mean of 2 sparse methods; dense 210 "
        "[190; 230]; dense with as many parameters 110 [85; 130]; 3 seeds."
    ]


def test_intervals_hold_no_return_that_is_impossible_and_two_seeds_have_none(folders):
    add(folders, "static", 0.8, [500.0, 500.0, 350.0])  # 450 +- 215 by Student's t
    add(folders, "dense", None, [400.0, 300.0])
    assert sentences(results(folders)) == [
        "CartPole-v1 at 80 %: Static 450 [230; 500] (3 seeds); dense 350 (2 seeds)."
    ]


def test_several_algorithms_are_named(folders):
    add(folders, "static", 0.9, [400.0])
    add(folders, "static", 0.9, [300.0], algo="ppo")
    assert sentences(results(folders)) == [
        "DQN, CartPole-v1 at 90 %: Static 400; 1 seed.",
        "PPO, CartPole-v1 at 90 %: Static 300; 1 seed.",
    ]
    assert [one.title for one in scores(results(folders))] == [
        "DQN, CartPole-v1",
        "PPO, CartPole-v1",
    ]


def test_a_table_has_a_row_for_each_method_and_the_highest_of_a_column_in_bold(folders):
    add(folders, "dense", None, [200.0] * 3)
    add(folders, "set", 0.9, [300.0] * 3)
    add(folders, "rigl", 0.9, [300.0] * 3)
    add(folders, "equal", 0.9, [204.0] * 3)
    add(folders, "rigl", 0.95, [100.0] * 3)
    (found,) = scores(results(folders))
    assert found.table.heads == ["method", "0 %", "90 %", "95 %"]
    best = Cell(300.0, "300 [300; 300]", strong=True)
    assert found.table.rows == [
        ["Dense", Cell(200.0, "200 [200; 200]"), None, None],
        ["Dense, equal parameters", None, Cell(204.0, "200 [200; 200]"), None],
        ["SET", None, best, None],
        ["RigL", None, best, Cell(100.0, "100 [100; 100]")],
    ]
    assert "3 seeds, 95 %" in found.note
    assert "bold" in found.note
    assert "SET and RigL 300 [300; 300], the highest mean of 2" in sentences(results(folders))[0]


def test_nothing_is_bold_below_three_seeds(folders):
    add(folders, "set", 0.9, [300.0] * 3)
    add(folders, "rigl", 0.9, [400.0] * 2)
    (found,) = scores(results(folders))
    assert found.table.rows == [
        ["SET", Cell(300.0, "300 [300; 300] (3)")],
        ["RigL", Cell(400.0, "400 (2)")],
    ]
    assert "bold" not in found.note


def test_scores_that_would_tie_have_a_third_digit(folders):
    add(folders, "set", 0.9, [301.0])
    add(folders, "rigl", 0.9, [304.0])
    (found,) = scores(results(folders))
    assert [row[1] for row in found.table.rows] == [
        Cell(301.0, "301"),
        Cell(304.0, "304"),
    ]


def test_a_varied_setting_has_the_columns(folders):
    for decay in (0.0, 1e-4):
        asked = {"weight_decay": decay}
        for level, score in ((0.8, 300.0), (0.9, 200.0)):
            add(
                folders, "rigl", level, [score + 1e5 * decay] * 3, policy=asked, overrides=asked,
            )  # fmt: skip
    (found,) = scores(results(folders, "weight_decay"))
    assert found.table.heads == ["method", "0.0", "0.0001"]
    assert [row[0] for row in found.table.rows] == ["RigL, 80 %", "RigL, 90 %"]
    assert [[cell.value for cell in row[1:]] for row in found.table.rows] == [
        [300.0, 310.0],
        [200.0, 210.0],
    ]
    assert "by weight_decay" in found.note


@pytest.mark.parametrize("label", ["dense", "equal"])
def test_without_a_sparse_method_there_is_no_sentence(folders, label):
    add(folders, label, 0.9, [1.0])
    assert sentences(results(folders)) == []
