"""Signal-to-noise ratios against SB3's own gradients and by hand."""

from __future__ import annotations

import copy
import csv

import numpy as np
import pytest
import stable_baselines3
import torch as th
from stable_baselines3.common.buffers import ReplayBufferSamples
from support import make

import sb3_sparse
from sb3_sparse import SparsityCallback
from sb3_sparse.analysis import GradientSNRCallback, PlasticityCallback, gradient_snr
from sb3_sparse.analysis.batches import own_randomness, sample_batch
from sb3_sparse.analysis.losses import losses_for
from sb3_sparse.analysis.networks import dense_twin, parameters_by_network
from sb3_sparse.analysis.snr import per_sample_gradients
from sb3_sparse.errors import ConfigError

STILL = {
    "DQN": dict(max_grad_norm=1e9),
    "SAC": {},
    "PPO": dict(max_grad_norm=1e9, n_epochs=1, clip_range_vf=0.2, ent_coef=0.1),
}


def mean_gradients(model, batch, chunk):
    """Means of the per-sample gradients, by parameter."""
    twin, names, found = dense_twin(model.policy), parameters_by_network(model.policy), {}
    with own_randomness(1, model.device), th.no_grad():
        losses = losses_for(type(model))(model, twin, batch)
    for loss in losses:
        trained = [name for network in loss.networks for name in names[network]]
        parts = list(per_sample_gradients(twin, loss, trained, chunk))
        for name in trained:
            found[name] = th.cat([part[name] for part in parts]).mean(dim=0)
    return found


def gradients_of_train(model, batch):
    """What SB3's ``train()`` hands to its optimizers for a batch."""
    names = {id(p): name for name, p in model.policy.named_parameters()}
    found = {}

    def note(optimizer, *_):
        for group in optimizer.param_groups:
            for p in group["params"]:
                if p.grad is not None:
                    found[names[id(p)]] = p.grad.clone()

    for owner in (model.policy, getattr(model, "actor", None), getattr(model, "critic", None)):
        if getattr(owner, "optimizer", None) is not None:
            owner.optimizer.register_step_pre_hook(note)
    th.manual_seed(1)
    if hasattr(model, "replay_buffer"):
        model.replay_buffer.sample = lambda *_, **__: batch
        model.train(1, 16)
    else:
        model.rollout_buffer.get = lambda _: iter([batch])
        model.train()
    return found


DENSE = {
    "SparsePolicy": dict(policy="MlpPolicy"),
    "SparseSimbaPolicy": dict(policy="SparseSimbaPolicy", policy_kwargs={"sparsity": 0.0}),
}


@pytest.mark.parametrize("policy", DENSE)
@pytest.mark.parametrize("compute", ["masked", "sparse"])
@pytest.mark.parametrize("name", STILL)
def test_per_sample_gradients_average_to_the_dense_gradient_of_sb3(name, compute, policy):
    arguments = dict(learning_rate=0.0, **STILL[name])
    sparse = make(name, policy=policy, policy_kwargs={"compute": compute}, **arguments)
    sparse.learn(40)
    stock = make(name, **DENSE[policy], **arguments)
    stock.learn(40)
    weights = sparse.policy.state_dict()
    with th.no_grad():
        for key, parameter in stock.policy.named_parameters():
            parameter.copy_(weights[key])
    batch = sample_batch(sparse)
    if name == "PPO":
        moved = 0.3 * th.randn(16, generator=th.Generator().manual_seed(0))
        batch = batch._replace(old_log_prob=batch.old_log_prob + moved)
    expected = gradients_of_train(stock, batch)
    found = mean_gradients(sparse, batch, chunk=5)
    assert found.keys() == expected.keys()
    for key, gradient in found.items():
        th.testing.assert_close(gradient, expected[key], rtol=1e-4, atol=1e-6, msg=key)
    inactive = ~weights[next(key for key in weights if key.endswith("weight_mask"))]
    assert inactive.any()
    layer = next(iter(sparse.policy.sparse.layers))
    assert found[f"{layer.name}.weight"][inactive].any()


def test_a_case_by_hand():
    model = make("DQN", policy="MlpPolicy", policy_kwargs={"net_arch": []})
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.zero_()
    observations = th.tensor([[1.0, 2.0, 0.0, 1.0], [1.0, 0.0, 2.0, -1.0]])
    zeros = th.zeros(2, 1)
    rewards = th.tensor([[0.5], [0.25]])
    batch = ReplayBufferSamples(observations, zeros.long(), observations, zeros, rewards)
    snr = gradient_snr(model, batch)
    # Gradients -r x: -0.5 and -0.25, -1 and 0, 0 and -0.5, -0.5 and 0.25; of the bias as the first
    connections = [3.0, 1.0, 1.0, 1 / 3, 0.0, 0.0, 0.0, 0.0]
    assert snr["q_net"].active == pytest.approx(sum(connections) / 8, rel=1e-5)
    assert snr["q_net"].all == pytest.approx((sum(connections) + 3.0 + 0.0) / 10, rel=1e-5)
    assert snr["q_net"].inactive is None
    assert snr.samples == 2


def test_active_and_inactive_add_up_to_all_connections():
    model = make("SAC")
    model.learn(40)
    whole, parts = gradient_snr(model), gradient_snr(model, chunk=5)
    assert whole.values().keys() == {
        f"snr/{network}{part}" for network in ("actor", "critic") for part in PARTS
    }
    assert whole.values() == pytest.approx(parts.values(), rel=1e-4)
    assert "snr/actor/inactive" in str(whole)
    assert gradient_snr(model, seed=1).values() != whole.values()


PARTS = ("", "/active", "/inactive")


@pytest.mark.parametrize("policy", ["SparsePolicy", "MlpPolicy"])
@pytest.mark.parametrize("name", STILL)
def test_measuring_leaves_no_trace(name, policy):
    model = make(name, policy=policy)
    model.learn(64)
    before = copy.deepcopy(model.policy.state_dict())
    grads = [None if p.grad is None else p.grad.clone() for p in model.policy.parameters()]
    generators = th.get_rng_state(), np.random.get_state()[1].copy(), np.random.get_state()[2]
    gradient_snr(model)
    assert th.equal(th.get_rng_state(), generators[0])
    np.testing.assert_array_equal(np.random.get_state()[1], generators[1])
    assert np.random.get_state()[2] == generators[2]
    for key, value in model.policy.state_dict().items():
        assert th.equal(value, before[key]), key
    for parameter, grad in zip(model.policy.parameters(), grads, strict=True):
        assert (parameter.grad is None) == (grad is None)
        assert grad is None or th.equal(parameter.grad, grad)
    assert th.distributions.Distribution._validate_args


@pytest.mark.parametrize("compute", ["masked", "sparse"])
@pytest.mark.parametrize("package", [stable_baselines3, sb3_sparse])
@pytest.mark.parametrize("name", STILL)
def test_training_is_the_same_with_and_without(name, package, compute, tmp_path):
    ends = []
    for watched in (False, True):
        model = make(getattr(package, name), policy_kwargs={"compute": compute})
        callbacks = [SparsityCallback("rigl", update_interval=5)]
        if watched:
            callbacks.append(GradientSNRCallback(32, path=tmp_path / "snr.csv"))
            callbacks.append(PlasticityCallback(32, path=tmp_path / "plasticity.csv"))
        model.learn(64, callback=callbacks)
        ends.append(model.policy.state_dict())
    assert (tmp_path / "snr.csv").read_text().count("\n") > 3
    for key, value in ends[0].items():
        assert th.equal(value, ends[1][key]), key


@pytest.mark.parametrize("compute", ["masked", "sparse"])
@pytest.mark.parametrize("name", ["DQN", "PPO"])
def test_images_and_shared_features_work(name, compute):
    kwargs = {"features_extractor_kwargs": {"features_dim": 8}, "net_arch": [8], "compute": compute}
    model = make(name, "TinyImages-v0", policy_kwargs=kwargs)
    model.learn(40)
    for network in gradient_snr(model).networks:
        assert network.all > 0
        assert network.inactive is not None


def test_dicts_work():
    model = make("PPO", "TinyDicts-v0", policy_kwargs={"net_arch": [8]})
    model.learn(40)
    before = model.rollout_buffer.observations["image"]
    assert gradient_snr(model)["actor"].all > 0
    assert model.rollout_buffer.observations["image"] is before


def rows_of(path):
    with path.open() as file:
        head, *rows = csv.reader(file)
    assert head == ["timesteps", "name", "value"]
    return [(int(steps), name) for steps, name, value in rows if float(value) >= 0]


def test_the_callback_writes_resumes_and_begins_anew(tmp_path):
    path = tmp_path / "run" / "snr.csv"
    model = make("DQN")
    model.learn(100, callback=GradientSNRCallback(30, path=path))
    names = [f"snr/q_net{part}" for part in PARTS]
    assert rows_of(path) == [(t, name) for t in (30, 60, 90) for name in names]
    with path.open("a") as file:
        file.write("120,snr/q_net,1.0\n150,snr/q_")
    model.learn(50, callback=GradientSNRCallback(30, path=path), reset_num_timesteps=False)
    assert rows_of(path) == [(t, name) for t in (30, 60, 90, 120, 150) for name in names]
    make("DQN").learn(40, callback=GradientSNRCallback(30, path=path))
    assert rows_of(path) == [(30, name) for name in names]


def test_the_callback_logs_and_ppo_is_measured_at_the_end_of_rollouts():
    model = make("PPO")
    logged = []
    callback = GradientSNRCallback(40, batch_size=8)
    measure = callback.measure

    def note(seed):
        logged.append(model.num_timesteps)
        return measure(seed)

    callback.measure = note
    model.learn(128, callback=callback, log_interval=1000)
    assert logged == [64, 96, 128]
    assert "snr/critic/inactive" in model.logger.name_to_value


def test_what_has_no_loss_or_nothing_to_measure_on_says_so():
    with pytest.raises(ConfigError, match="no loss of TD3; supported are DQN, SAC, PPO"):
        make("TD3").learn(10, callback=GradientSNRCallback(5))
    with pytest.raises(ConfigError, match="nothing to measure on"):
        gradient_snr(make("DQN"))
    with pytest.raises(ConfigError, match="every"):
        GradientSNRCallback(0)
    model = make("SAC", use_sde=True)
    model.learn(30)
    with pytest.raises(ConfigError, match="use_sde"):
        gradient_snr(model)
    with pytest.raises(ConfigError, match="batch_size"):
        gradient_snr(model, batch_size=0)
    with pytest.raises(ConfigError, match="batch that is given"):
        gradient_snr(model, sample_batch(model), batch_size=4)
