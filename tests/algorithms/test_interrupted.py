"""Training that is saved, copied, changed or interrupted in the middle goes on as in stock SB3."""

from __future__ import annotations

import copy
import gc
import pickle
import weakref

import pytest
import stable_baselines3
import torch as th
from algorithms_support import (
    NAMES,
    OFF_POLICY,
    STOCK,
    Noise,
    actions_of,
    assert_alike,
    fused,
    learn,
    make,
    moving,
    tensors_of,
)
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv

import sb3_sparse

LIBRARIES = (sb3_sparse, STOCK)
MORE = {"PPO": 32, "A2C": 50}


def more(model, callback=None):
    """Ten gradient steps from here, of random numbers that are the same for all models."""
    name = next(name for name in NAMES[::-1] if isinstance(model, getattr(STOCK, name)))
    set_random_seed(5)
    model.action_space.seed(5)
    return learn(model, callback, MORE.get(name, 10))


@pytest.mark.parametrize("storage", ["masked", "sparse"])
@pytest.mark.parametrize("name", NAMES)
def test_files_go_from_ours_to_stock_and_back(name, storage, tmp_path):
    ours = learn(make(sb3_sparse, name, policy_kwargs=dict(compute=storage)))
    assert type(ours).__name__ == name
    assert isinstance(ours, getattr(STOCK, name))
    ours.save(tmp_path / "ours")
    if name in OFF_POLICY:
        ours.save_replay_buffer(tmp_path / "buffer")

    def load(library, path):
        model = getattr(library, name).load(tmp_path / path, env=Noise(actions_of(name)))
        if name in OFF_POLICY:
            model.load_replay_buffer(tmp_path / "buffer")
        return model

    stock = load(STOCK, "ours")
    assert type(stock) is getattr(STOCK, name)
    before = tensors_of(ours)
    for key, tensor in tensors_of(stock).items():
        th.testing.assert_close(tensor, before[key], rtol=0, atol=0)
    again = load(sb3_sparse, "ours")
    more(stock)
    more(again)
    assert fused(again)
    assert_alike(again, stock)
    stock.save(tmp_path / "stock")
    back = load(sb3_sparse, "stock")
    more(back)
    more(stock := load(STOCK, "stock"))
    assert fused(back)
    assert_alike(back, stock)


@pytest.mark.parametrize("method", ["static", "rigl"])
@pytest.mark.parametrize("name", NAMES)
def test_a_copy_goes_on_as_the_model_does(name, method):
    for library in LIBRARIES:
        model = learn(make(library, name), moving(method))
        copied = copy.deepcopy(model)
        before = tensors_of(model)
        more(copied, moving(method))
        for key, tensor in tensors_of(model).items():
            assert th.equal(tensor, before[key]), key
        more(model, moving(method))
        assert_alike(model, copied, exact=True)
    assert fused(learn(make(sb3_sparse, name)))


def test_policies_and_models_pickle():
    for name in ("SAC", "A2C"):
        model = learn(make(sb3_sparse, name))
        policy = pickle.loads(pickle.dumps(model.policy))
        for key, tensor in model.policy.state_dict().items():
            assert th.equal(th.as_tensor(policy.state_dict()[key]), th.as_tensor(tensor)), key
        assert pickle.loads(pickle.dumps(model._trains())).reason is None


class Meddler(BaseCallback):
    """Changes the model at some steps."""

    def __init__(self, changes):
        super().__init__()
        self.changes = changes

    def _on_step(self):
        change = self.changes.get(self.n_calls)
        if change is not None:
            change(self.model)
        return True


def set_rate(model):
    model.lr_schedule = lambda remaining: 2e-3


def load_weights(model):
    """Those of a model that has trained elsewhere."""
    state = th.random.get_rng_state()
    other = make(STOCK, type(model).__name__, seed=11)
    th.random.set_rng_state(state)
    model.set_parameters(other.get_parameters())


def load_policy(model):
    numbers = model.policy.state_dict()
    scaled = {k: v * 0.5 if th.is_tensor(v) and v.is_floating_point() else v
              for k, v in numbers.items()}  # fmt: skip
    model.policy.load_state_dict(scaled)


def load_optimizer(model):
    optimizer = getattr(model.policy, "critic", model.policy).optimizer
    optimizer.load_state_dict(copy.deepcopy(optimizer.state_dict()))


def write_weights(model):
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.mul_(0.9)


def move_data(model):
    for parameter in model.policy.parameters():
        parameter.data = parameter.data.clone() * 0.9


def reset_moments(model):
    for optimizer in model.policy.sparse.optimizers:
        optimizer.state.clear()


def set_numbers(model):
    model.gamma = 0.8
    model.tau = 0.2
    model.ent_coef_tensor = th.tensor(0.7)
    model.vf_coef = 0.2
    model.ent_coef = 0.03
    model.max_grad_norm = 0.01
    model.policy_delay = 3
    model.target_entropy = -0.5
    model.target_policy_noise = 0.05
    model.batch_size = 13
    model.normalize_advantage = not getattr(model, "normalize_advantage", True)


CHANGES = [set_rate, load_weights, load_policy, load_optimizer, write_weights, move_data,
           reset_moments, set_numbers]  # fmt: skip


CASES = [
    (change, storage)
    for change in CHANGES
    for storage in ("masked", "sparse")
    if (change, storage) != (load_weights, "sparse")  # its weights are those of another mask
]


@pytest.mark.parametrize(("change", "storage"), CASES)
@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_callbacks_that_change_the_model(name, change, storage):
    models = []
    for library in LIBRARIES:
        model = make(library, name, policy_kwargs=dict(compute=storage))
        models.append(learn(model, Meddler({25: change, 35: change})))
    assert fused(models[0])
    assert_alike(*models)


@pytest.mark.parametrize("name", ["SAC", "TD3", "PPO"])
def test_a_new_environment(name):
    models = []
    for library in LIBRARIES:
        model = learn(make(library, name))
        model.set_env(DummyVecEnv([lambda: Noise(actions_of(name))]), force_reset=True)
        models.append(more(model))
    assert_alike(*models)


class Enough(Exception):
    pass


@pytest.mark.parametrize("name", NAMES)
def test_an_interrupted_run_goes_on(name):
    def stop(model):
        raise Enough

    models = []
    for library in LIBRARIES:
        model = make(library, name)
        with pytest.raises(Enough):
            learn(model, Meddler({30: stop}))
        models.append(more(more(model)))
    assert_alike(*models)


def test_checkpoints_and_statistics_are_true_at_any_moment(tmp_path):
    folders = []
    for library in LIBRARIES:
        folders.append(tmp_path / str(len(folders)))
        callback = CheckpointCallback(30, str(folders[-1]), save_replay_buffer=True)
        learn(make(library, "SAC"), callback)
    loaded = [stable_baselines3.SAC.load(folder / "rl_model_30_steps") for folder in folders]
    assert_alike_tensors(*loaded)


def assert_alike_tensors(one, two):
    one, two = tensors_of(one), tensors_of(two)
    assert one.keys() == two.keys()
    for name, tensor in one.items():
        th.testing.assert_close(tensor, two[name], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_equal_seeds_give_equal_runs(name):
    models = [learn(make(sb3_sparse, name), moving("rigl")) for _ in range(2)]
    assert_alike(*models, exact=True)


@pytest.mark.parametrize("name", ["SAC", "PPO"])
@pytest.mark.parametrize("storage", ["masked", "sparse"])
def test_two_threads_agree_with_one(name, storage):
    kwargs = dict(policy_kwargs=dict(compute=storage), batch_size=200)
    if name == "PPO":
        kwargs.update(n_steps=200, n_epochs=5)
    one = learn(make(sb3_sparse, name, **kwargs), moving("rigl"), 400 if name == "PPO" else 40)
    th.set_num_threads(2)
    try:
        two = make(sb3_sparse, name, **kwargs)
        learn(two, moving("rigl"), 400 if name == "PPO" else 40)
    finally:
        th.set_num_threads(1)
    assert fused(two)
    assert_alike(two, one)


@pytest.mark.parametrize("name", ["SAC", "DQN", "PPO", "TQC", "QRDQN", "CrossQ"])
def test_every_instruction_set(name, instructions):
    stock = learn(make(STOCK, name), moving("rigl"))
    ours = learn(make(sb3_sparse, name), moving("rigl"))
    assert_alike(ours, stock)


@pytest.mark.parametrize("name", NAMES)
def test_models_are_freed(name):
    model = learn(make(sb3_sparse, name), moving("rigl"))
    assert fused(model)
    references = [weakref.ref(model), weakref.ref(model.policy)]
    references += [weakref.ref(machine) for machine in model._trains()._machines.values()]
    del model
    gc.collect()
    assert [reference() for reference in references] == [None] * len(references)


def test_a_rate_that_moves_makes_no_new_programs():
    model = make(sb3_sparse, "SAC", learning_rate=lambda remaining: 1e-3 * remaining)
    learn(model)
    assert len(model._trains()._machines) == 1


def test_a_share_that_moves_makes_no_new_programs():
    def follow_faster(model):
        model.tau *= 1.05

    models = [
        learn(make(library, "SAC"), Meddler(dict.fromkeys(range(50), follow_faster)))
        for library in LIBRARIES
    ]
    assert len(models[0]._trains()._machines) == 1
    assert_alike(*models)
