from __future__ import annotations

import copy

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from support import make

from sb3_sparse.policies.gaussian_actor import FastSquashedGaussian


@settings(max_examples=50, deadline=None)
@given(
    batch=st.integers(1, 40),
    dim=st.integers(1, 7),
    scale=st.floats(0.1, 4.0),
    shift=st.floats(-4.0, 1.5),
    seed=st.integers(0, 2**20),
)
def test_actions_log_probabilities_and_gradients_are_those_of_sb3(batch, dim, scale, shift, seed):
    random = th.Generator().manual_seed(seed)
    mean = scale * th.randn(batch, dim, generator=random)
    log_std = shift + 0.5 * th.randn(batch, dim, generator=random)
    weights = th.randn(batch, dim, generator=random), th.randn(batch, generator=random)
    found = []
    for kind in (SquashedDiagGaussianDistribution, FastSquashedGaussian):
        # In double precision: SB3's formula cancels where ours does not.
        m, s = (t.double().requires_grad_() for t in (mean, log_std))
        th.manual_seed(seed)
        distribution = kind(dim)
        action, log_prob = distribution.log_prob_from_params(m, s)
        ((action * weights[0]).sum() + (log_prob * weights[1]).sum()).backward()
        found.append([action, log_prob, distribution.gaussian_actions, m.grad, s.grad, th.rand(3)])
    for ours, theirs in zip(found[1], found[0], strict=True):
        np.testing.assert_allclose(ours.detach(), theirs.detach(), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", ["SAC", "TQC", "CrossQ"])
def test_sparse_actors_use_it_and_dense_ones_do_not(name):
    sparse, dense = make(name), make(name, policy_kwargs=dict(sparsity=0.0))
    assert type(sparse.actor.action_dist) is FastSquashedGaussian
    assert type(dense.actor.action_dist) is SquashedDiagGaussianDistribution
    assert type(make(name, use_sde=True).actor.action_dist) is not FastSquashedGaussian
    pruned = make(name, policy_kwargs=dict(initial_sparsity=0.0))
    assert type(pruned.actor.action_dist) is FastSquashedGaussian


def test_thirty_updates_are_those_with_sb3s_distribution():
    found = []
    for fast in (True, False):
        model = make("SAC")
        if not fast:
            model.actor.action_dist = SquashedDiagGaussianDistribution(1)
        found.append(model.learn(50).policy.state_dict())
    for key, value in found[0].items():
        np.testing.assert_allclose(value, found[1][key], rtol=1e-3, atol=1e-5, err_msg=key)


def test_what_is_not_a_number_is_reported_as_in_sb3():
    distribution = FastSquashedGaussian(2)
    with pytest.raises(ValueError, match="Expected parameter loc"):
        distribution.log_prob_from_params(th.full((3, 2), float("nan")), th.zeros(3, 2))


def test_a_model_can_be_copied_right_after_training():
    model = make("SAC").learn(25)
    copy.deepcopy(model.policy)


def test_the_distribution_is_that_of_the_last_observations():
    distribution = FastSquashedGaussian(2)
    distribution.log_prob_from_params(th.zeros(5, 2), th.zeros(5, 2))
    mean = th.full((3, 2), 0.5)
    distribution.log_prob_from_params(mean, th.zeros(3, 2))
    np.testing.assert_allclose(distribution.mode(), np.tanh(mean))
    assert distribution.sample().shape == (3, 2)
    with pytest.raises(AttributeError):
        FastSquashedGaussian(2).sample()


def test_second_derivatives_are_refused():
    mean = th.zeros(3, 2, requires_grad=True)
    _, log_prob = FastSquashedGaussian(2).log_prob_from_params(mean, th.zeros(3, 2))
    (first,) = th.autograd.grad(log_prob.sum(), mean, create_graph=True)
    with pytest.raises(RuntimeError, match="does not require grad|once_differentiable"):
        first.sum().backward()


def test_the_last_distribution_keeps_its_graph_and_the_actor_can_be_copied():
    model = make("SAC", policy_kwargs=dict(sparsity=0.5))
    actor = model.policy.actor
    actor.action_log_prob(th.as_tensor(model.observation_space.sample()[None]))
    twin = copy.deepcopy(actor)
    assert not twin.action_dist.distribution.mean.requires_grad
    assert actor.action_dist.distribution.mean.requires_grad
