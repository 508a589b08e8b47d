"""The two storages side by side, in every algorithm."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import support
from stable_baselines3.common.callbacks import BaseCallback
from support import ALGORITHMS, DISCRETE, TinyImages, make

from sb3_sparse import SparsityCallback

METHODS = {"static": {}, "set": {"update_interval": 4}, "rigl": {"update_interval": 4},
           "prune": {"update_interval": 2}, "granet": {"update_interval": 4}}  # fmt: skip
STEPS = {"PPO": 64, "TRPO": 64, "A2C": 160}
ON_IMAGES = ("DQN", "PPO", "SAC", "TRPO")
CASES = [*ALGORITHMS, *(f"{name} on images" for name in ON_IMAGES)]
STOP = {"TRPO": 33, "TRPO on images": 33, "PPO on images": 33}
"""After one rollout: TRPO draws noise for each stored value, so other numbers follow; PPO has taken
20 gradient steps, and rounding grows."""


class StopAt(BaseCallback):
    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps

    def _on_step(self) -> bool:
        return self.num_timesteps < self.steps


@pytest.fixture(autouse=True)
def storage():
    """Each of these tests has both storages in it, so none is chosen from outside."""


def trained(case: str, method: str, compute: str):
    """A model after some steps.

    :param case: an algorithm; on images its network has convolutions
    """
    name, _, images = case.partition(" on ")
    start = {"initial_sparsity": 0.0} if method in ("prune", "granet") else {}
    kwargs = dict(compute=compute, sparsity=0.8, **start)
    env = None
    if images:
        env = TinyImages(discrete=name in (*DISCRETE, "PPO", "TRPO"))
        kwargs.update(features_extractor_kwargs=dict(features_dim=16), net_arch=[16])
    model = make(name, env, policy_kwargs=kwargs)
    callbacks = [StopAt(STOP.get(case, 1000)), SparsityCallback(method, **METHODS[method])]
    return model.learn(STEPS.get(name, 46), callback=callbacks)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("case", CASES)
def test_the_same_moves_connection_for_connection_and_the_same_weights(case, method):
    masked, sparse = (trained(case, method, compute) for compute in ("masked", "sparse"))
    assert all(layer.is_sparse for layer in sparse.policy.sparse.layers)
    ours, theirs = sparse.policy.state_dict(), masked.policy.state_dict()
    assert list(ours) == list(theirs)
    if method != "static":
        assert max(n.mask_updates for n in sparse.policy.sparse.networks) > 0
    # A bias before a BatchRenorm has gradient 0 but for rounding, which Adam makes a whole step of.
    loose = case == "CrossQ"
    # A weight of a convolution may have a gradient of rounding alone, too: at most a step is lost.
    step, relative = (3e-4, 1e-2) if "images" in case else (2e-5, 1e-3)
    for key, value in theirs.items():
        if key.endswith("weight_mask") or key == "_extra_state":
            np.testing.assert_array_equal(ours[key], value, err_msg=key)
        elif not loose:
            np.testing.assert_allclose(ours[key], value, rtol=1e-3, atol=step, err_msg=key)
    if loose:
        return
    for one, other in zip(
        masked.policy.sparse.optimizers, sparse.policy.sparse.optimizers, strict=True
    ):
        ones, others = one.state_dict()["state"], other.state_dict()["state"]
        assert list(ones) == list(others)
        for number, state in ones.items():
            for key, value in state.items():
                scale = max(float(value.abs().max()), 1e-6)
                np.testing.assert_allclose(others[number][key], value, atol=relative * scale)


@pytest.mark.parametrize("saver", ["masked", "sparse"])
@pytest.mark.parametrize("case", CASES)
def test_what_one_storage_saved_the_other_resumes(case, saver, tmp_path, monkeypatch):
    model = trained(case, "set", saver)
    model.save(tmp_path / "model")
    other = {"masked": "sparse", "sparse": "masked"}[saver]
    kwargs = {**model.policy_kwargs, "compute": other}
    twins = [
        type(model).load(tmp_path / "model", env=model.get_env(), custom_objects=objects)
        for objects in (None, {"policy_kwargs": kwargs})
    ]
    assert [all(layer.is_sparse for layer in t.policy.sparse.layers) for t in twins] == [
        saver == "sparse",
        other == "sparse",
    ]
    for one, same in zip(twins[0].get_parameters().items(), twins[1].get_parameters().items(),
                         strict=True):  # fmt: skip
        assert_equal(one, same)
    observation = model.observation_space.sample()
    actions = [twin.predict(observation, deterministic=True)[0] for twin in twins]
    np.testing.assert_allclose(actions[0], actions[1], rtol=1e-4, atol=1e-5)
    copy.deepcopy(twins[1].policy)
    twins[1].learn(40, callback=SparsityCallback("set", update_interval=2))
    support.assert_masked(twins[1])


def assert_equal(one, other) -> None:
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_equal(one[key], other[key])
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_equal(a, b)
    else:
        np.testing.assert_array_equal(np.asarray(one), np.asarray(other))
