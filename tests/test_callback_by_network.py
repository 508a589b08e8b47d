"""The callback with a method, or an option, for each network."""

from __future__ import annotations

import pytest
from support import make

from sb3_sparse import SparsityCallback
from sb3_sparse.errors import ConfigError


def logged(model) -> dict[str, float]:
    values = model.logger.name_to_value
    return {name: value for name, value in values.items() if "drop_fraction" in name}


def learn(callback, steps=40, **policy_kwargs):
    model = make("SAC", policy_kwargs=policy_kwargs)
    return model.learn(steps, callback=callback, log_interval=10**9)


def test_an_option_is_for_all_networks_or_by_network():
    plans = SparsityCallback(
        {"actor": "set", "critic": "prune"},
        update_interval={"critic": 500},
        drop_fraction=0.2,
        begin={"critic": 0.1, "actor": None},
        end=0.6,
        update_on={"actor": "rollout"},
    ).plans
    actor, critic, other = plans["actor"], plans["critic"], plans["other"]
    assert (actor.method, critic.method, other.method) == ("set", "prune", "static")
    assert (actor.update_interval, critic.update_interval) == (1000, 500)
    assert (actor.drop_fraction, actor.begin, critic.begin) == (0.2, 0.0, 0.1)
    assert (actor.end, critic.end) == (0.6, 0.6)
    assert (actor.update_on, critic.update_on) == ("rollout", "step")


def test_each_method_begins_when_it_usually_does():
    plans = SparsityCallback({"actor": "rigl", "critic": "prune"}).plans
    assert (plans["actor"].begin, plans["critic"].begin) == (0.0, 0.2)


def test_one_method_takes_options_by_network_too():
    plans = SparsityCallback("rigl", update_interval={"critic": 7}).plans
    assert (plans["critic"].update_interval, plans["actor"].update_interval) == (7, 1000)
    assert plans["critic"].method == plans["actor"].method == "rigl"


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ({"critic": "riggle"}, {}, "unknown method 'riggle'.*did you mean 'rigl'"),
        ({}, {}, "name at least one"),
        (
            {"actor": "static", "critic": "rigl"},
            dict(update_interval={"actor": 5}),
            "method 'static' of 'actor' has no update_interval; it takes no options",
        ),
        ({"critic": "rigl"}, dict(end={"actor": 0.8}), "method 'static' of 'actor' has no end"),
        (
            {"actor": "prune", "critic": "rigl"},
            dict(drop_fraction={"actor": 0.5}),
            "method 'prune' of 'actor' has no drop_fraction; it takes begin, end",
        ),
        (
            {"actor": "static", "critic": "prune"},
            dict(drop_fraction=0.2),
            "method 'critic=prune' has no drop_fraction",
        ),
        ({"critic": "rigl"}, dict(update_interval={"critic": 0}), "critic: update_interval must"),
        ({"critic": "rigl"}, dict(end={"critic": "late"}), "critic: begin and end are fractions"),
    ],
)
def test_wrong_arguments_are_named_with_their_network(method, options, message):
    with pytest.raises(ConfigError, match=message):
        SparsityCallback(method, **options)


@pytest.mark.parametrize(
    "callback",
    [
        SparsityCallback({"critics": "rigl"}),
        SparsityCallback("rigl", update_interval={"critics": 5}),
    ],
)
def test_a_network_that_the_policy_lacks_is_refused_with_those_that_it_has(callback):
    with pytest.raises(ConfigError, match="no network 'critics'.*'actor', 'critic'"):
        learn(callback)


def test_drop_fractions_are_logged_by_network_where_plans_differ():
    callback = SparsityCallback({"critic": "rigl"}, update_interval=5, end=1.0)
    model = learn(callback)
    assert logged(model) == {
        "sparsity/drop_fraction": 0.0,
        "sparsity/actor_drop_fraction": 0.0,
        "sparsity/critic_drop_fraction": 0.0,
    }
    model.policy.sparse.progress = 0.5  # half of the cosine
    callback.on_rollout_end()
    assert logged(model) == {
        "sparsity/drop_fraction": pytest.approx(0.25),
        "sparsity/actor_drop_fraction": 0.0,
        "sparsity/critic_drop_fraction": pytest.approx(0.25),
    }


@pytest.mark.parametrize("method", ["rigl", {"actor": "rigl", "critic": "rigl"}])
def test_one_plan_logs_one_drop_fraction(method):
    assert list(logged(learn(SparsityCallback(method, update_interval=5)))) == [
        "sparsity/drop_fraction"
    ]


def test_a_network_without_an_update_is_warned_of_and_a_static_one_is_not():
    with pytest.warns(UserWarning, match=r"'rigl' had no mask update.*\(critic: 20 steps\)"):
        learn(SparsityCallback({"actor": "set", "critic": "rigl"}, update_interval={"actor": 5}))


def test_a_static_network_is_not_warned_of(recwarn):
    learn(SparsityCallback({"actor": "set"}, update_interval=5))
    assert not recwarn.list


@pytest.mark.parametrize(
    ("method", "sparsity", "hint"),
    [
        ({"critic": "prune"}, 0.9, r"initial_sparsity=\{'critic': 0.0\} in policy_kwargs"),
        ({"critic": "granet"}, 0.8, r"initial_sparsity=\{'critic': 0.4\}.*\(50% of the sparsity\)"),
        ("granet", 0.8, r"initial_sparsity=0.4 in policy_kwargs \(50% of the sparsity\)"),
        ("granet", {"actor": 0.5, "critic": 0.8}, r"\{'actor': 0.25, 'critic': 0.4\}"),
    ],
)
def test_a_network_that_is_pruned_must_start_denser_and_the_message_says_how(
    method, sparsity, hint
):
    with pytest.raises(ConfigError, match=f"starts denser than it ends.*{hint}"):
        learn(SparsityCallback(method), sparsity=sparsity)


def test_each_network_that_is_pruned_must_start_denser():
    with pytest.raises(ConfigError, match="'prune' needs .* and actor would not: give"):
        learn(SparsityCallback("prune"), initial_sparsity={"critic": 0.0})
    with pytest.raises(ConfigError, match="'granet' needs .* and critic would not: give"):
        learn(
            SparsityCallback({"actor": "prune", "critic": "granet"}),
            initial_sparsity={"actor": 0.0},
        )


def test_a_network_that_stays_dense_needs_no_denser_start():
    callback = SparsityCallback("prune", update_interval=5)
    model = learn(callback, sparsity={"actor": 0.0, "critic": 0.9}, initial_sparsity=0.0)
    assert model.policy.sparsity_report().sparsity("critic") == pytest.approx(0.9, abs=0.01)


def test_a_network_that_starts_denser_must_be_pruned():
    with pytest.raises(ConfigError, match="'static' of actor would never.*'granet' or 'prune'"):
        learn(SparsityCallback({"critic": "prune"}), initial_sparsity=0.0)
    with pytest.raises(ConfigError, match="'rigl' of critic would never"):
        learn(
            SparsityCallback({"actor": "prune", "critic": "rigl"}),
            initial_sparsity={"actor": 0.0, "critic": 0.5},
        )


def test_granet_ends_exact_even_if_no_gradient_comes_after_the_end():
    model = learn(SparsityCallback("granet", update_interval=10**6, end=1.0), initial_sparsity=0.45)
    for layer in model.policy.sparse.layers:
        assert layer.nnz == layer.final_nnz


def test_an_option_of_a_network_without_a_method_is_named_so():
    with pytest.raises(ConfigError, match="'critc' is not among 'actor', 'critic', so its method"):
        SparsityCallback({"actor": "static", "critic": "rigl"}, update_interval={"critc": 5})
