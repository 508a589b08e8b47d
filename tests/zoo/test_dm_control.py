"""Tasks of dm_control: how they are found, made and counted."""

from __future__ import annotations

import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import FlattenObservation

from sb3_sparse.errors import ConfigError
from sb3_sparse.wrappers import ActionRepeat
from sb3_sparse.zoo.environments import known_environment, suite_of
from sb3_sparse.zoo.spec import RunSpec

pytest.importorskip("dm_control")
DOG = "dm_control/dog-stand-v0"


def test_a_task_is_found_by_its_id_and_a_mistyped_one_is_corrected():
    known_environment(DOG)
    assert DOG in gym.registry
    with pytest.raises(ConfigError, match="did you mean 'dm_control/dog-stand-v0'"):
        known_environment("dm_control/dog-stnd-v0")


def test_the_suite_is_known_by_name():
    assert suite_of(DOG) == "DeepMind Control"
    assert suite_of("dm_control/pendulum-swingup-v0") == "DeepMind Control"
    assert suite_of("Pendulum-v1") == "classic control"


def test_an_episode_of_1000_steps_is_500_decisions():
    known_environment(DOG)
    env = FlattenObservation(ActionRepeat(gym.make(DOG), repeat=2))
    assert env.observation_space.shape == (223,)
    assert env.action_space.shape == (38,)
    env.reset(seed=0)
    decisions, over = 0, False
    while not over:
        _, reward, terminated, over, _ = env.step(np.zeros(38))
        assert 0 <= reward <= 2  # each step's is in [0, 1]
        assert not terminated
        decisions += 1
    assert decisions == 500


def test_equal_seeds_give_equal_episodes():
    known_environment(DOG)
    first, second = (gym.make(DOG) for _ in range(2))
    one, other = (env.reset(seed=3)[0] for env in (first, second))
    assert all((one[name] == other[name]).all() for name in one)


def test_a_worker_that_unpickles_a_run_knows_its_environment():
    run = pickle.dumps(RunSpec(algo="sac", env_id=DOG, method="static"))
    code = (
        "import pickle, sys; run = pickle.loads(sys.stdin.buffer.read()); "
        "import gymnasium; print(run.env_id in gymnasium.registry)"
    )
    done = subprocess.run([sys.executable, "-c", code], input=run, capture_output=True, check=True)
    assert done.stdout.split() == [b"True"]
