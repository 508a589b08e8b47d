"""What runs cost, by made-up runs that have been timed; all numbers are worked out by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from study_support import archived

from sb3_sparse.studies.cell import Cell
from sb3_sparse.studies.cost import Cost, Costs, but_for_seeds
from sb3_sparse.studies.status import CellState, CellStatus
from sb3_sparse.zoo.archive import Archive
from sb3_sparse.zoo.record import Record
from sb3_sparse.zoo.spec import RunSpec

SET = RunSpec("dqn", "CartPole-v1", method="set", sparsity=0.9, n_timesteps=2000)


def changed(**values) -> RunSpec:
    return replace(SET, **values)


def timed(run: RunSpec, spent: float | None, **more) -> Record:
    """The record of a run that took so many seconds of the processor."""
    return archived(Cell(run), spent, **more).record


def seconds(costs: Costs, run: RunSpec, done: int = 0) -> float:
    return costs.of(Cell(run), done).seconds


def test_a_cost_is_the_median_of_runs_that_differ_in_the_seed_alone():
    records = [timed(changed(seed=seed), spent) for seed, spent in enumerate((10.0, 90.0, 20.0))]
    assert Costs(records).of(Cell(changed(seed=7))) == Cost(1, 20.0, {0: 1})


def test_it_is_scaled_by_steps_and_what_is_done_costs_nothing():
    costs = Costs([timed(changed(n_timesteps=500, eval_freq=50, device="cpu"), 5.0)])
    assert seconds(costs, SET) == 20.0
    assert seconds(costs, SET, done=1500) == 5.0
    assert seconds(costs, SET, done=2000) == seconds(costs, SET, done=2004) == 0.0


@pytest.mark.parametrize(
    ("place", "run"),
    [
        (0, changed(seed=3)),
        (1, changed(hyperparams={"batch_size": 32})),
        (2, changed(sparsity=0.5)),
        (2, changed(method="rigl")),
        (2, changed(method="dense", sparsity=None)),
        (2, changed(method="dense", sparsity=None, match_params=0.9)),
        (3, changed(env_id="Acrobot-v1")),
    ],
)
def test_the_runs_that_are_most_like_it_count(place, run):
    others = [
        timed(changed(hyperparams={"net_arch": [8]}), 2.0),
        timed(changed(method="static"), 3.0),
        timed(changed(env_id="MountainCar-v0"), 4.0),
    ]
    # What counts for a place counts for those that follow, and medians are over all of it.
    wanted = {0: 1.0, 1: 1.5, 2: 2.0, 3: 2.5}
    assert Costs([timed(SET, 1.0), *others]).of(Cell(run)) == Cost(1, wanted[place], {place: 1})


def test_a_dense_network_of_equal_size_is_none_of_full_size():
    dense = changed(method="dense", sparsity=None)
    costs = Costs([timed(dense, 9.0), timed(replace(dense, match_params=0.9), 1.0)])
    own = {"hyperparams": {"batch_size": 32}}
    assert seconds(costs, replace(dense, **own)) == 9.0
    assert seconds(costs, replace(dense, match_params=0.9, **own)) == 1.0


@pytest.mark.parametrize(
    "record",
    [
        timed(SET, None),  # of a version that did not count seconds
        timed(SET, 5.0, status="diverged"),
        timed(SET, 5.0, num_timesteps=0),
        timed(SET, 5.0, seconds={"wall": 1.0}),  # damaged
        timed(changed(env_id="CartPole-v1", algo="ppo"), 5.0),
    ],
    ids=["old", "diverged", "counted", "damaged", "other"],
)
def test_without_a_timed_run_of_the_algorithm_the_cost_is_unknown(record):
    found = Costs([record]).of(Cell(SET))
    assert found == Cost(1, unknown=frozenset({"DQN"}))
    assert str(found) == "1 run, core hours unknown"
    assert found.remarks() == ["no run of DQN has been timed yet"]


def test_on_a_gpu_the_seconds_that_passed_count():
    both = {"wall": 7.0, "processor": 5.0}
    assert seconds(Costs([timed(SET, 0.0, seconds=both, device="cuda")]), SET) == 7.0
    assert seconds(Costs([timed(SET, 0.0, seconds=both, device="cpu")]), SET) == 5.0


def test_a_cell_that_is_only_counted_costs_nothing():
    assert Costs([]).of(Cell(SET, trained=False)) == Cost(1)


def test_costs_add_up_and_say_what_they_are_made_of():
    total = Cost(2, 1800.0, {0: 1, 2: 1}) + Cost(3, 3600.0, {2: 2, 3: 1})
    assert str(total) == "5 runs, 1.5 core hours"
    assert total.remarks() == ["3 by other methods in their environment", "1 by other environments"]
    partly = total + Cost(1, unknown=frozenset({"SAC"})) + Cost(1, unknown=frozenset({"PPO"}))
    assert str(partly) == "7 runs, more than 1.5 core hours"
    assert partly.remarks()[-1] == "no run of PPO and SAC has been timed yet"


def statuses(*states: tuple[CellState, int], run: RunSpec = SET) -> list[CellStatus]:
    """Cells of one seed after the other."""
    cells = [Cell(replace(run, seed=seed)) for seed in range(len(states))]
    return [
        CellStatus(cell, cell.folder(Path("none")), *state)
        for cell, state in zip(cells, states, strict=True)
    ]


DONE, HALF, OPEN = (CellState.DONE, 2000), (CellState.STOPPED, 1000), (CellState.WAITING, 0)
COSTS = Costs([timed(SET, 10.0)])


def test_what_is_left_is_what_is_not_over():
    diverged = (CellState.DIVERGED, 300)
    assert COSTS.left(statuses(DONE, HALF, OPEN, diverged)) == Cost(2, 15.0, {0: 2})


@pytest.mark.parametrize(
    ("seeds", "runs", "spent"),
    [(1, 0, 0.0), (2, 1, 5.0), (3, 2, 15.0), (5, 4, 35.0)],  # two are done, or none is planned
)
def test_seeds_beyond_the_planned_ones_count(seeds, runs, spent):
    found = COSTS.to_seeds(statuses(DONE, HALF, OPEN), seeds)
    assert (found.runs, found.seconds) == (runs, spent)


def test_a_diverged_seed_is_none_of_those_that_are_wanted():
    found = COSTS.to_seeds(statuses(DONE, (CellState.DIVERGED, 300)), 2)
    assert (found.runs, found.seconds) == (1, 10.0)


def test_cells_that_differ_in_the_seed_alone_belong_together():
    one, other = statuses(OPEN, OPEN), statuses(OPEN, OPEN, run=changed(sparsity=0.5))
    mixed = [one[0], other[0], one[1], other[1]]
    assert but_for_seeds(mixed) == [one, other]


def test_runs_of_the_archive_and_of_folders_count_once(tmp_path):
    """Whichever study they are of."""
    archive = Archive(tmp_path / "runs.jsonl")
    cells = [Cell(changed(seed=seed)) for seed in range(3)]
    archive.add([archived(cells[0], 10.0), archived(cells[1], 20.0)])
    for cell, spent in ((cells[1], 500.0), (cells[2], 90.0)):
        folder = cell.folder(tmp_path)
        folder.path.mkdir(parents=True)
        (folder.path / "sparsity.json").write_text(json.dumps(dict(timed(cell.run, spent))))
    (tmp_path / "runs/dqn/Broken-v1_0").mkdir()
    (tmp_path / "runs/dqn/Broken-v1_0/sparsity.json").write_text("{")
    lines = archive.read()
    assert seconds(Costs.known(tmp_path, lines), SET) == 20.0  # the median of 10, 20 and 90
    assert seconds(Costs.known(tmp_path), SET) == 295.0  # of 500 and 90
    assert seconds(Costs.known(tmp_path / "none", lines), SET) == 15.0
