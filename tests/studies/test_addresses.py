"""Addresses name runs for good: folders and archives of old are looked up by them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sb3_sparse.studies import Study

# As they were when the first archive was written. A change of these makes all that was run be run
# again: change them only where a run comes out otherwise.
KNOWN = {
    ("actor_critic", "small"): {
        "sac HalfCheetah-v5 dense, net_arch {'pi': [315, 315], 'qf': [221, 221]}, seed 0": (
            "706b5896da94"
        ),
    },
    ("classic_control", "smoke"): {
        "dqn CartPole-v1 dense, learning_starts 50, seed 0": "3098ea48fa70",
    },
    ("classic_control", "small"): {"dqn CartPole-v1 rigl 99%, seed 0": "ae8ce3e36b8a"},
    ("classic_control", "medium"): {"dqn Acrobot-v1 static 95%, seed 0": "59045acb04c3"},
    ("classic_control", "paper"): {"dqn MountainCar-v0 prune 50%, seed 7": "6c30d1719397"},
    ("dqn_resnet", "small"): {
        "dqn PongNoFrameskip-v4 dense as 90% of dqn_impala, buffer_size 20000, "
        "learning_starts 5000, seed 0": "b70f9b69ac05",
    },
    ("flops", "small"): {
        "dqn MsPacmanNoFrameskip-v4 static 60% of dqn uniform, seed 0": "72c7bc46ac41",
    },
    ("last_layer_dense", "smoke"): {
        "sac Pendulum-v1 rigl 90%, update_interval 20, learning_starts 50, dense_layers [], "
        "seed 0": "7cf90e95fbdd",
    },
    ("noise", "small"): {"dqn Acrobot-v1 dense as 50%, seed 0": "1a8fa9730274"},
    ("ppo", "small"): {"ppo HalfCheetah-v5 dense, seed 2": "9c8b13558b39"},
    ("ppo", "medium"): {"ppo HalfCheetah-v5 dense as 90%, seed 0": "186f6fa985f9"},
    ("sac", "medium"): {"sac Hopper-v5 dense, seed 3": "5b49c64f90fc"},
    ("sac", "paper"): {"sac HalfCheetah-v5 dense as 95%, seed 0": "ab6461f2dd41"},
    ("snr", "small"): {"dqn CartPole-v1 rigl 90%, seed 0": "870042e7d9cd"},
    ("weight_decay", "small"): {
        "sac HalfCheetah-v5 set 80%, weight_decay 1e-06, seed 0": "142065b1b475",
    },
}
RUNS = Path(__file__).parents[2] / "docs/results/runs.jsonl"


@pytest.mark.parametrize("where", KNOWN, ids=" ".join)
def test_addresses_are_what_they_always_were(where):
    cells = {cell.name: cell for cell in Study.read(*where).cells}
    assert {name: cells[name].address for name in KNOWN[where]} == KNOWN[where]


@pytest.mark.skipif(not RUNS.is_file(), reason="a source distribution has no archive of runs")
def test_every_run_that_is_in_the_archive_is_one_of_todays_studies():
    scales = [("classic_control", "small"), ("classic_control", "medium"), ("noise", "small")]
    scales += [(name, scale) for name in ("ppo", "sac", "snr") for scale in ("small", "medium")]
    scales += [(name, "small") for name in ("actor_critic", "robust_value", "scaling")]
    scales += [
        (name, scale) for name in ("distribution", "weight_decay") for scale in ("small", "medium")
    ]
    scales += [("noise", "medium")]
    known = {cell.address for where in scales for cell in Study.read(*where).cells}
    lines = [json.loads(line) for line in RUNS.read_text().splitlines()]
    assert len(lines) >= 211
    strangers = [line["record"]["run"] for line in lines if line["address"] not in known]
    assert strangers == []
