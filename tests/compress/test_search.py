"""The search, with a pruner on which the return is a known function of the sparsity."""

from __future__ import annotations

import pytest

from sb3_sparse.compress.guard import Interval
from sb3_sparse.compress.record import CompressionRecord, open_record
from sb3_sparse.compress.search import Level, Rules, next_sparsity, search
from sb3_sparse.errors import ConfigError, CorruptStateError

EPISODES = 4


class FakePruner:
    """Returns 100 up to a sparsity, then 90, with a noise that pairs do not share."""

    def __init__(self, breaks_at: float, noise: float = 0.0, stop_at: int | None = None) -> None:
        self.breaks_at = breaks_at
        self.noise = noise
        self.calls = 0
        self.stop_at = stop_at
        self.made: list[float] = []
        self.kept: list[int] = []
        self.candidate = 0.0

    def _count(self) -> None:
        self.calls += 1
        if self.calls == self.stop_at:
            raise KeyboardInterrupt

    def make(self, number: int, sparsity: float) -> int:
        self._count()
        self.made.append(sparsity)
        self.candidate = sparsity
        return round(1000 * (1 - sparsity))

    def returns(self, baseline: bool, batch: int) -> list[float]:
        self._count()
        if baseline:
            return [100.0] * EPISODES
        mean = 100.0 if self.candidate <= self.breaks_at else 90.0
        return [mean + self.noise * sign for sign in (1, -1, 1, -1)]

    def accept(self, number: int) -> None:
        self._count()
        self.kept.append(number)


RULES = Rules(start=0.0, floor=0.003, max_drop=0.03, goal=None, batches=3)


def run(pruner, rules=RULES, record=None, save=lambda: None) -> CompressionRecord:
    record = record or CompressionRecord({})
    search(rules, pruner, record.baseline, record.levels, save, lambda line: None)
    return record


def test_it_climbs_until_a_level_fails_and_halves_the_gap_twice():
    pruner = FakePruner(breaks_at=0.8)
    record = run(pruner)
    # densities 0.6, 0.36, 0.216 pass; 0.1296 fails; sqrt(0.216 * 0.1296) = 0.167313 fails;
    # sqrt(0.216 * 0.167313) = 0.190104 fails
    assert pruner.made == [0.4, 0.64, 0.784, 0.8704, 0.832687, 0.809896]
    assert [level.verdict for level in record.levels] == ["passed"] * 3 + ["failed"] * 3
    assert pruner.kept == [1, 2, 3]
    assert record.accepted == 3
    assert record.levels[2].nnz == 216
    assert record.levels[3].change == Interval(-10.0, -10.0, -10.0)


def test_halving_goes_up_again_from_what_passes():
    pruner = FakePruner(breaks_at=0.84)
    record = run(pruner)
    # 0.167313 passes; sqrt(0.167313 * 0.1296) = 0.147253 fails
    assert pruner.made[4:] == pytest.approx([0.832687, 0.852746], abs=2e-6)
    assert [level.verdict for level in record.levels[4:]] == ["passed", "failed"]
    assert record.accepted == 5


def test_a_model_that_tolerates_nothing_stays_as_it_is():
    pruner = FakePruner(breaks_at=0.1)
    record = run(pruner)
    assert pruner.made == [0.4, 0.225403, 0.119888]  # densities 0.6, sqrt(0.6), 0.6 ** 0.25
    assert record.accepted == 0
    assert pruner.kept == []


def test_it_ends_where_every_layer_has_one_connection():
    pruner = FakePruner(breaks_at=1.0)
    record = run(pruner)
    assert record.levels[-1].sparsity == pytest.approx(1 - 0.6**11, abs=1e-6)  # 0.0036; 0.0022 next
    assert {level.verdict for level in record.levels} == {"passed"}


def test_it_begins_at_what_a_sparse_model_has():
    pruner = FakePruner(breaks_at=0.93)
    run(pruner, Rules(start=0.9, floor=0.001, max_drop=0.03, goal=None, batches=1))
    assert pruner.made == pytest.approx([0.94, 0.92254, 0.931826], abs=2e-6)


def test_a_fixed_sparsity_is_reached_exactly_and_without_a_guard():
    pruner = FakePruner(breaks_at=0.5)
    record = run(pruner, Rules(start=0.0, floor=0.003, max_drop=None, goal=0.9, batches=1))
    assert pruner.made == [0.4, 0.64, 0.784, 0.8704, 0.9]
    assert {level.verdict for level in record.levels} == {"done"}
    assert record.levels[-1].change.mean == -10.0


def test_an_open_level_is_played_on_and_then_fails():
    # standard deviation of 4 pairs +-10: 11.5, so that 12 episodes leave +-6.6: not decided at 3
    pruner = FakePruner(breaks_at=1.0, noise=10.0)
    record = run(pruner)
    assert [level.verdict for level in record.levels] == ["undecided"] * 3
    assert {len(level.returns) for level in record.levels} == {3 * EPISODES}
    assert sorted(record.baseline) == [0, 1, 2]
    # +-3: 4 episodes leave +-5.5, 8 leave +-2.7
    record = run(FakePruner(breaks_at=0.5, noise=3.0))
    assert (record.levels[0].verdict, len(record.levels[0].returns)) == ("passed", 2 * EPISODES)


def test_a_baseline_of_nothing_is_refused_before_anything_is_trained():
    pruner = FakePruner(breaks_at=1.0)
    pruner.returns = lambda baseline, batch: [-1.0, 1.0, -1.0, 1.0]
    with pytest.raises(ConfigError, match="cannot be told from 0"):
        run(pruner)
    assert pruner.made == []


@pytest.mark.parametrize("breaks_at", [0.84, 0.1])
def test_an_interruption_anywhere_changes_nothing(breaks_at, tmp_path):
    whole = run(FakePruner(breaks_at, noise=3.0))
    calls = FakePruner(breaks_at, noise=3.0)
    run(calls)
    for stop_at in range(1, calls.calls + 1):
        folder = tmp_path / str(stop_at)
        folder.mkdir()
        for stop in (stop_at, None):
            record = open_record(folder, {"steps": 1})
            pruner = FakePruner(breaks_at, noise=3.0, stop_at=stop)
            done = len(record.levels)
            try:
                run(pruner, record=record, save=lambda: record.save(folder))  # noqa: B023
            except KeyboardInterrupt:
                assert stop is not None
            else:
                assert stop is None
                assert len(pruner.made) == len(whole.levels) - done
        assert record.levels == whole.levels
        assert record.baseline == whole.baseline


def test_other_settings_and_a_damaged_file_are_named(tmp_path):
    level = Level(0.4, 10, "done", (1.0, 1.0), Interval(0, 0, 0))
    CompressionRecord({"steps": 10, "seed": 1, "max_drop": 0.03}, levels=[level]).save(tmp_path)
    with pytest.raises(ConfigError, match=r"steps 10 instead of 20, max_drop 0.03 instead of None"):
        open_record(tmp_path, {"steps": 20, "seed": 1, "max_drop": None})
    (tmp_path / "compress.json").write_text('{"settings": {')
    with pytest.raises(CorruptStateError, match="remove the folder"):
        open_record(tmp_path, {})


def test_nothing_is_next_when_the_goal_is_reached():
    level = Level(0.9, 10, "done", (1.0, 1.0), Interval(0, 0, 0))
    assert next_sparsity([level], 0.0, 0.9, 0.0) is None
