"""What it costs to act: the numbers are of the policy that is given."""

from __future__ import annotations

from statistics import median

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize
from support import TinyImages, make

from sb3_sparse.errors import ConfigError, UnsupportedError
from sb3_sparse.export.timing import ROUNDS, acting_cost, c_burst, measure, with_loop


@pytest.mark.parametrize("name", ["SAC", "DQN", "PPO"])
def test_the_cost_is_of_the_networks_that_act(name):
    model = make(name, policy_kwargs=dict(sparsity=0.5))
    cost = acting_cost(model)
    inputs, outputs = (4, 2) if name == "DQN" else (3, 1)
    weights = inputs * 24 + 24 * 24 + 24 * outputs
    assert cost.dense_bytes == 4 * (weights + 24 + 24 + outputs)
    assert 0 < cost.flash < cost.dense_bytes
    assert cost.c > 0
    assert cost.predict > 0


def test_the_loop_runs_each_observation_in_turn_and_counts_actions(tmp_path):
    source = tmp_path / "policy.c"
    source.write_text(
        "#include <stdio.h>\n"
        "void sb3_sparse_policy(const float *obs, float *action)\n"
        "{\n"
        f'    FILE *file = fopen("{tmp_path}/seen", "a");\n'
        '    fprintf(file, "%g ", obs[1]);\n'
        "    fclose(file);\n"
        "    *action = 0.0f;\n"
        "}\n"
    )
    rows = np.array([[0, 1], [0, 2], [0, 3]], np.float32)
    assert c_burst(with_loop(source), rows, 1)(5) > 0
    assert (tmp_path / "seen").read_text().split() == ["1", "2", "3", "1", "2"]


def test_a_time_of_each_round_is_of_one_action():
    counts: list[int] = []

    def burst(count: int) -> float:
        counts.append(count)
        if count == 20:
            return 4e-3  # one action 0.2 ms, so 10 actions fill a burst of 2 ms
        return count * (1e-3 if len(counts) % 8 else 1.0)  # every fourth long burst is disturbed

    (times,) = measure([burst])
    assert median(times) == 1e-3
    assert len(times) == ROUNDS
    assert counts == [20, 20, *[3, 10] * ROUNDS]


def test_images_are_not_timed():
    with pytest.raises(UnsupportedError, match="timed on vectors"):
        acting_cost(make("DQN", TinyImages()))


def test_frames_that_are_stacked_after_normalisation_are_not_timed():
    envs = VecFrameStack(VecNormalize(make_vec_env("CartPole-v1")), 2)
    with pytest.raises(ConfigError, match="if its frames were stacked after normalisation"):
        acting_cost(make("PPO", envs))


def test_without_a_compiler_the_reason_is_given(monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(UnsupportedError, match="no-such-compiler"):
        acting_cost(make("SAC"))


def test_a_loop_that_does_not_compile_says_what_the_compiler_says(tmp_path):
    source = tmp_path / "policy.c"
    source.write_text("int broken(")
    with pytest.raises(UnsupportedError, match="cannot compile the loop"):
        with_loop(source)
