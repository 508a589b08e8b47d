"""NaN and infinity end as they do in stock SB3: the same exception, and nothing else changed."""

from __future__ import annotations

import pytest
import torch as th
from algorithms_support import STOCK, Noise, fused, learn, make, tensors_of
from gymnasium import spaces
from stable_baselines3.common.utils import set_random_seed

import sb3_sparse

NAN, INF = float("nan"), float("inf")


def first_bias(network):
    return next(module.bias for module in network.modules() if isinstance(module, th.nn.Linear))


def last_bias(network):
    return [m.bias for m in network.modules() if isinstance(m, th.nn.Linear)][-1]


PLACES = {
    "SAC": ["actor.latent_pi", "actor.mu", "actor.log_std", "critic.qf0", "critic_target.qf1"],
    "TD3": ["actor.mu", "actor_target.mu", "critic.qf0", "critic_target.qf1"],
    "DQN": ["q_net.q_net", "q_net_target.q_net"],
    "TQC": ["actor.latent_pi", "actor.mu", "actor.log_std", "critic.qf0", "critic_target.qf1"],
    "QRDQN": ["quantile_net.quantile_net", "quantile_net_target.quantile_net"],
    "CrossQ": ["actor.mu", "actor.log_std", "critic.qf0"],
    "PPO": ["mlp_extractor.policy_net", "action_net", "value_net"],
    "A2C": ["mlp_extractor.policy_net", "action_net", "value_net"],
}
CASES = [
    (name, place, number)
    for name, places in PLACES.items()
    for place in places
    for number in (NAN, INF)
    if (place, number)
    != ("actor.latent_pi", INF)  # all is NaN or nothing, which of them may differ
]


def end_of(library, name, spoil, env=None, **kwargs):
    """How a round of gradient steps ends, and the model."""
    # Without zeros: stock multiplies gradients by masks, and 0 times NaN is no 0.
    model = learn(make(library, name, env, policy_kwargs=dict(sparsity=0.0), **kwargs))
    with th.no_grad():
        spoil(model.policy)
    set_random_seed(5)
    arguments = () if name in ("PPO", "A2C") else (3, 70)
    ended = None
    try:
        model.train(*arguments)
    except ValueError as error:
        ended = error
    return model, ended


def assert_as_finite(ours, stock):
    """What is finite is finite in both, and equal to rounding."""
    one, two = tensors_of(ours), tensors_of(stock)
    for key, tensor in one.items():
        finite = th.isfinite(two[key])
        assert th.equal(th.isfinite(tensor), finite), key
        th.testing.assert_close(tensor[finite], two[key][finite], rtol=1e-3, atol=1e-5)


def assert_ends_alike(name, spoil, env=lambda: None, **kwargs):
    ours, ended = end_of(sb3_sparse, name, spoil, env(), **kwargs)
    stock, should = end_of(STOCK, name, spoil, env(), **kwargs)
    assert fused(ours)
    assert type(ended) is type(should), (ended, should)
    if should is not None:
        assert str(ended).splitlines()[0] == str(should).splitlines()[0]
    assert_as_finite(ours, stock)
    return should


@pytest.mark.parametrize(("name", "place", "number"), CASES)
def test_a_bias_that_is_not_finite(name, place, number):
    def spoil(policy):
        last_bias(policy.get_submodule(place))[0] = number

    assert_ends_alike(name, spoil)


@pytest.mark.parametrize("rounds", [0, 1, 2])
def test_an_error_leaves_norms_in_the_mode_of_stock(rounds):
    modes = []
    for library in (sb3_sparse, STOCK):
        model = learn(make(library, "CrossQ", policy_kwargs=dict(sparsity=0.0)))
        sample = model.replay_buffer.sample
        calls = []

        def draw(*args, sample=sample, calls=calls, model=model, **kwargs):
            if len(calls) == rounds:
                with th.no_grad():
                    last_bias(model.policy.actor.mu)[0] = NAN
            calls.append(args)
            return sample(*args, **kwargs)

        model.replay_buffer.sample = draw
        with pytest.raises(ValueError, match="Expected parameter"):
            model.train(4, 70)
        assert library is STOCK or fused(model)
        modes.append([module.training for module in model.policy.modules()])
    assert modes[0] == modes[1]


@pytest.mark.parametrize("name", PLACES)
def test_a_nan_passes_through_hidden_layers(name):
    def spoil(policy):
        first_bias(policy)[0] = NAN

    assert_ends_alike(name, spoil)


@pytest.mark.parametrize("number", [NAN, INF, -INF, -200.0, 50.0])
@pytest.mark.parametrize("name", ["PPO", "A2C"])
def test_a_deviation_that_is_none(name, number):
    def spoil(policy):
        policy.log_std[1] = number

    assert_ends_alike(name, spoil)


@pytest.mark.parametrize("number", [NAN, INF, -INF])
@pytest.mark.parametrize(
    "space", [spaces.Discrete(4), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(3)], ids=str
)
def test_logits(space, number):
    def spoil(policy):
        policy.action_net.bias[1] = number

    assert_ends_alike("PPO", spoil, lambda: Noise(space))


@pytest.mark.parametrize("name", ["SAC", "CrossQ", "PPO", "A2C"])
def test_without_checks_training_goes_on(name, monkeypatch):
    monkeypatch.setattr(th.distributions.Distribution, "_validate_args", False)

    def spoil(policy):
        network = policy.action_net if name in ("PPO", "A2C") else policy.actor.mu
        last_bias(network)[0] = NAN

    assert assert_ends_alike(name, spoil) is None


@pytest.mark.parametrize("name", ["SAC", "TD3", "DQN", "TQC", "QRDQN", "CrossQ"])
def test_rewards_that_are_not_finite(name):
    # Of huge gradients, a norm leaves what rounding has made of them.
    for number in (NAN, INF) if name == "CrossQ" else (NAN, INF, 1e30):
        models = []
        for library in (sb3_sparse, STOCK):
            model = make(library, name, policy_kwargs=dict(sparsity=0.0))
            learn(model, steps=50)
            model.replay_buffer.rewards[:] = number
            set_random_seed(5)
            model.train(1, 70)
            models.append(model)
        assert_as_finite(*models)
