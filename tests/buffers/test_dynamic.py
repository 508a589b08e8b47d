"""The dynamic replay buffer, against SB3's own and against a plain list of transitions."""

from __future__ import annotations

import copy
import pickle
import tracemalloc

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer

from sb3_sparse.buffers import DynamicReplayBuffer
from sb3_sparse.errors import ConfigError
from sb3_sparse.zoo.replay import BufferSaver, end_episodes, restore_buffer

VECTOR = spaces.Box(-1, 1, (1,), np.float32)
ACTIONS = spaces.Box(-1, 1, (2,), np.float32)


def make(size: int, envs: int = 1, **kwargs) -> DynamicReplayBuffer:
    return DynamicReplayBuffer(size * envs, VECTOR, ACTIONS, device="cpu", n_envs=envs, **kwargs)


def add(buffer, number: int, done: bool = False, cut_off: bool = False) -> None:
    """Add a row whose observation, reward and action say its number."""
    envs = buffer.n_envs
    value = np.arange(envs, dtype=np.float32) * 1000 + number
    action = np.stack([value, value], axis=1)
    infos = [{"TimeLimit.truncated": cut_off}] * envs
    dones = np.full(envs, done or cut_off)
    buffer.add(value[:, None], value[:, None] + 0.5, action, value, dones, infos)


def numbers(buffer) -> list[int]:
    """The rows in use, from the oldest."""
    return [int(n) for n in buffer.observations[buffer.oldest(buffer.size()), 0, 0]]


def drawn(buffer, count: int = 400):
    return buffer.sample(count)


@given(
    size=st.integers(1, 12),
    moves=st.lists(st.tuples(st.booleans(), st.integers(0, 15)), max_size=12),
    seed=st.integers(0, 3),
)
@settings(max_examples=200, deadline=None)
def test_it_holds_what_a_list_would(size, moves, seed):
    buffer, rows, added = make(size), [], 0
    for adds, count in moves:
        if adds:
            for _ in range(count):
                add(buffer, added)
                rows.append(added)
                added += 1
            rows = rows[-size:]
        elif rows:
            count = min(count, len(rows) - 1)
            buffer.shrink(count)
            rows = rows[count:]
        assert buffer.size() == len(rows)
        assert numbers(buffer) == rows
        assert buffer.without_means == len(rows)
        newest = buffer.observations[buffer.newest(min(3, len(rows))), 0, 0]
        assert newest.tolist() == rows[-3:]
        if rows:
            np.random.seed(seed)
            batch = buffer.sample(len(rows) * 30)
            assert {int(n) for n in batch.observations[:, 0]} <= set(rows)
            assert (batch.next_observations[:, 0] == batch.observations[:, 0] + 0.5).all()


def test_every_row_in_use_is_drawn_and_no_other():
    buffer = make(8)
    for number in range(11):  # 3 to 10 are left, in a ring that begins in its middle
        add(buffer, number)
    buffer.shrink(3)
    np.random.seed(0)
    assert {int(n) for n in drawn(buffer).observations[:, 0]} == {6, 7, 8, 9, 10}
    for number in (11, 12, 13):
        add(buffer, number)
    assert numbers(buffer) == [*range(6, 14)]  # it has grown to its capacity again
    assert buffer.forgotten == 0
    add(buffer, 14)
    assert numbers(buffer) == [*range(7, 15)]


def test_a_sample_costs_nothing_that_grows_with_the_buffer():
    buffer = make(200_000)
    buffer.observations[:, 0, 0] = np.arange(200_000)
    buffer.pos, buffer.full = 3, True
    buffer.shrink(9)
    np.random.seed(0)
    expected = (12 + np.random.randint(0, 199_991, size=16)) % 200_000
    np.random.seed(0)
    tracemalloc.start()
    batch = buffer.sample(16)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 100_000  # bytes; an index of each row would take 1,600,000
    assert batch.observations[:, 0].tolist() == expected.tolist()


def test_returns_over_three_steps_by_hand():
    buffer = make(8, n_steps=3, gamma=0.5)
    for number in range(11):
        add(buffer, number, done=number == 8)
    buffer.shrink(2)  # 5 to 10 are left, and the episode ends at 8
    np.random.seed(0)
    batch = drawn(buffer)
    # reward 5 + 6 / 2 + 7 / 4, then from 7.5 on with 0.5³; 7 stops at 8; 9 and 10 at the newest
    expected = {
        5: (5 + 3 + 1.75, 7.5, 0.125, 0),
        6: (6 + 3.5 + 2, 8.5, 0.125, 1),
        7: (7 + 4, 8.5, 0.25, 1),
        8: (8, 8.5, 0.5, 1),
        9: (9 + 5, 10.5, 0.25, 0),
        10: (10, 10.5, 0.5, 0),
    }
    found = {
        int(obs): (reward, following, discount, done)
        for obs, reward, following, discount, done in zip(
            batch.observations[:, 0].tolist(),
            batch.rewards[:, 0].tolist(),
            batch.next_observations[:, 0].tolist(),
            batch.discounts[:, 0].tolist(),
            batch.dones[:, 0].tolist(),
            strict=True,
        )
    }
    assert found == expected


def filled_and_drawn(buffer, count):
    """A batch of a buffer with as many rows, with ends and cut-offs among them."""
    for number in range(count):
        add(buffer, number, done=number % 5 == 4, cut_off=number % 7 == 6)
    np.random.seed(0)
    return buffer.sample(50)


@pytest.mark.parametrize("count", [3, 8, 13])
def test_one_step_is_the_replay_buffer_of_sb3(count):
    one, other = make(8, 2), ReplayBuffer(16, VECTOR, ACTIONS, device="cpu", n_envs=2)
    batches = [filled_and_drawn(buffer, count) for buffer in (one, other)]
    for mine, theirs in zip(*batches, strict=True):
        assert (mine is None and theirs is None) or (mine == theirs).all()
    assert batches[0].discounts is None


@pytest.mark.parametrize("count", [5, 13])
def test_several_steps_are_those_of_sb3(count):
    one = make(8, 2, n_steps=3, gamma=0.9)
    other = NStepReplayBuffer(16, VECTOR, ACTIONS, device="cpu", n_envs=2, n_steps=3, gamma=0.9)
    batches = [filled_and_drawn(buffer, count) for buffer in (one, other)]
    for mine, theirs in zip(*batches, strict=True):
        assert (mine == theirs).all()


def test_means_belong_to_their_rows():
    buffer = make(4, 2)
    for number in range(3):
        add(buffer, number)
    buffer.store_means(buffer.actions[:3] / 2)
    for number in (3, 4):
        add(buffer, number)
    assert buffer.without_means == 2
    buffer.store_means(buffer.actions[buffer.newest(2)] / 2)
    assert buffer.without_means == 0
    rows = buffer.oldest(4)
    assert (buffer.action_means[rows] == buffer.actions[rows] / 2).all()
    assert buffer.action_means[rows][:, 1, 0].tolist() == [500.5, 501, 501.5, 502]


def test_a_buffer_of_sb3_is_taken_over():
    other = ReplayBuffer(16, VECTOR, ACTIONS, device="cpu", n_envs=2)
    for number in range(11):
        add(other, number)
    buffer = DynamicReplayBuffer.from_buffer(other)
    assert buffer.observations is other.observations
    assert buffer.size() == buffer.without_means == 8
    assert buffer.action_means.shape == (8, 2, 2)
    buffer.shrink(6)
    assert numbers(buffer) == [9, 10]


@pytest.mark.parametrize("how", ["copy", "pickle", "files"])
def test_it_comes_back_as_it_was(how, tmp_path):
    buffer = make(8, 2, n_steps=3, gamma=0.5)
    for number in range(11):
        add(buffer, number)
    buffer.store_means(buffer.actions[buffer.newest(8)] / 2)
    buffer.shrink(3)
    if how == "copy":
        again = copy.deepcopy(buffer)
    elif how == "pickle":
        again = pickle.loads(pickle.dumps(buffer))
    else:
        BufferSaver(buffer).save(tmp_path / "saved", 11)
        again = make(8, 2)
        restore_buffer(again, tmp_path / "saved")
    add(buffer, 11)
    add(again, 11)
    assert numbers(again) == numbers(buffer) == [6, 7, 8, 9, 10, 11]
    assert (again.n_steps, again.gamma, again.forgotten, again.without_means) == (3, 0.5, 2, 1)
    assert (again.action_means == buffer.action_means).all()
    batches = []
    for one in (buffer, again):
        end_episodes(one)
        np.random.seed(0)
        batches.append(one.sample(50))
    assert all((x == y).all() for x, y in zip(*batches, strict=True))


def test_reset_empties_it():
    buffer = make(4)
    for number in range(6):
        add(buffer, number)
    buffer.shrink(2)
    buffer.reset()
    assert (buffer.size(), buffer.forgotten, buffer.without_means) == (0, 0, 0)
    add(buffer, 7)
    assert numbers(buffer) == [7]


@pytest.mark.parametrize("rows", [3, 4, -1, 1.5, True])
def test_it_forgets_neither_all_nor_what_is_no_number(rows):
    buffer = make(4)
    for number in range(3):
        add(buffer, number)
    with pytest.raises(ConfigError, match="of 3 rows a buffer can forget any number but all, got"):
        buffer.shrink(rows)
    assert numbers(buffer) == [0, 1, 2]


def test_means_of_another_shape_are_refused():
    buffer = make(4)
    add(buffer, 0)
    with pytest.raises(ConfigError, match=r"take an array of shape \(1, 1, 2\), got \(1, 2\)"):
        buffer.store_means(np.zeros((1, 2)))


def test_what_it_cannot_hold_is_refused():
    space = spaces.Dict({"a": VECTOR})
    with pytest.raises(ConfigError, match="optimize_memory_usage, got DictReplayBuffer"):
        DynamicReplayBuffer.from_buffer(DictReplayBuffer(4, space, ACTIONS))
    small = dict(optimize_memory_usage=True, handle_timeout_termination=False)
    with pytest.raises(ConfigError, match="got ReplayBuffer with it"):
        DynamicReplayBuffer.from_buffer(ReplayBuffer(4, VECTOR, ACTIONS, **small))
    with pytest.raises(NotImplementedError, match="optimize_memory_usage"):
        make(4, **small)
