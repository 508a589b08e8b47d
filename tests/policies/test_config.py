from __future__ import annotations

import inspect
from dataclasses import fields

import pytest
from support import make

from sb3_sparse import SparseSACPolicy
from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.config import SparsityConfig


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (dict(sparsity=None), r"needs its sparsity, e.g. policy_kwargs=dict\(sparsity=0.9\)"),
        (dict(sparsity=1.0), r"\[0, 1\).*got 1.0"),
        (dict(sparsity=-0.1), "got -0.1"),
        (dict(sparsity="most"), "got 'most'"),
        (dict(sparsity={"actor": 0.5, "critic": 2}), "sparsity of 'critic' must lie"),
        (
            dict(sparsity={"actor": 0.5, "critic": 0.5}, actor_share=0.5),
            "actor_share divides one sparsity",
        ),
        (dict(sparsity=0.9, initial_sparsity=1.5), "initial_sparsity must lie"),
        (dict(sparsity=0.9, distribution="flat"), "'flat'; allowed are er, erk, uniform"),
        (dict(sparsity=0.9, dense_layers="output"), r"must be a list of names.*got 'output'"),
        (dict(sparsity=0.9, sparsity_aware_init="yes"), "true or false, got 'yes'"),
        (dict(sparsity=0.9, mask_seed=-1), "0 or more, got -1"),
        (dict(sparsity=0.9, weight_decay=-3.0), "weight_decay must be 0 or more, got -3.0"),
    ],
)
def test_values_that_are_not_allowed_are_named_with_what_is(wrong, message):
    with pytest.raises(ConfigError, match=message):
        SparsityConfig(**wrong)


def test_a_policy_without_sparsity_does_not_train_dense():
    with pytest.raises(ConfigError, match="needs its sparsity"):
        make("SAC", policy_kwargs=dict(sparsity=None))


def test_a_mistyped_argument_is_named_with_the_nearest_one():
    with pytest.raises(
        ConfigError, match="unknown argument of SparseSACPolicy 'spasity' .did you mean 'sparsity'"
    ):
        make("SAC", policy="SparsePolicy", policy_kwargs=dict(spasity=0.9))
    with pytest.raises(ConfigError, match="'net_arc' .did you mean 'net_arch'"):
        make("SAC", policy_kwargs=dict(net_arc=[8]))


def test_help_shows_the_sparse_arguments_of_a_policy():
    shown = inspect.signature(SparseSACPolicy).parameters
    for one in fields(SparsityConfig):
        assert shown[one.name].default in (one.default, inspect.Parameter.empty)


def test_each_network_can_have_its_own_sparsity():
    model = make("SAC", policy_kwargs=dict(sparsity=dict(actor=0.5, critic=0.8)))
    report = model.policy.sparsity_report()
    assert report.sparsity("actor") == pytest.approx(0.5, abs=0.01)
    assert report.sparsity("critic") == pytest.approx(0.8, abs=0.01)


def test_networks_that_do_not_match_are_named():
    with pytest.raises(ConfigError, match=r"for 'actor', 'value'; .* networks 'actor', 'critic'"):
        make("SAC", policy_kwargs=dict(sparsity=dict(actor=0.5, value=0.8)))
    with pytest.raises(ConfigError, match="networks 'q_net'"):
        make("DQN", policy_kwargs=dict(sparsity=dict(actor=0.5, critic=0.5)))


def test_actor_share_divides_what_remains_with_both_critics_counted():
    # Pendulum, 24 wide: actor 3-24-24-(1+1): 72 + 576 + 48 = 696; each critic 4-24-24-1: 696.
    model = make("SAC", policy_kwargs=dict(sparsity=0.8, actor_share=0.5))
    actor, critic = model.policy.sparse.networks
    assert (actor.size, critic.size) == (696, 1392)
    # 20 % of 2088 is 417.6; half of it each.
    assert abs(actor.nnz - 208.8) <= 2 * len(actor.layers)
    assert abs(critic.nnz - 208.8) <= 2 * len(critic.layers)


def test_an_infeasible_actor_share_names_the_feasible_range():
    # 0.8 * 2088 = 1670.4 remain; the actor can take 696 of them, the critics 1392.
    with pytest.raises(ConfigError, match=r"between 0.1667 and 0.4166"):
        make("SAC", policy_kwargs=dict(sparsity=0.2, actor_share=0.9))


@pytest.mark.parametrize("share", [0.1667, 0.4166])
def test_the_ends_of_the_range_that_is_named_are_feasible(share):
    make("SAC", policy_kwargs=dict(sparsity=0.2, actor_share=share))


def test_actor_share_needs_an_actor():
    with pytest.raises(ConfigError, match="this policy has 'q_net'"):
        make("DQN", policy_kwargs=dict(actor_share=0.5))


def test_a_start_sparser_than_the_end_is_refused():
    with pytest.raises(ConfigError, match=r"initial_sparsity=0.95 is above the sparsity 0.9"):
        make("SAC", policy_kwargs=dict(initial_sparsity=0.95))


def test_the_start_may_be_given_by_network_and_a_network_left_out_starts_as_it_ends():
    for start in (dict(critic=0.0), dict(critic=0.0, actor=None)):
        actor, critic = make(
            "SAC", policy_kwargs=dict(initial_sparsity=start)
        ).policy.sparse.networks
        assert [layer.nnz for layer in actor.layers] == [layer.final_nnz for layer in actor.layers]
        assert critic.nnz == critic.size
        assert critic.denser
        assert not actor.denser


def test_a_start_by_network_is_checked_by_name_and_by_value():
    with pytest.raises(ConfigError, match="given for 'value'; .* networks 'actor', 'critic'"):
        make("SAC", policy_kwargs=dict(initial_sparsity=dict(value=0.5)))
    with pytest.raises(ConfigError, match="initial_sparsity of 'actor' must be a number"):
        make("SAC", policy_kwargs=dict(initial_sparsity=dict(actor="little")))
    with pytest.raises(ConfigError, match="initial_sparsity=0.95 is above .* of 'critic'"):
        make("SAC", policy_kwargs=dict(initial_sparsity=dict(critic=0.95)))


def test_json_lists_are_accepted_where_policy_kwargs_came_from_a_file():
    model = make("SAC", policy_kwargs=dict(dense_layers=["output"]))
    assert model.policy.sparse.networks[0].dense_layers
