"""What is searched, for which method, and what is refused."""

from __future__ import annotations

import pytest
from support import LeastIndex
from tuning_support import choices, small_run

from sb3_sparse.errors import ConfigError
from sb3_sparse.tuning import Space, paper_space, space_of
from sb3_sparse.tuning.backend import optuna
from sb3_sparse.tuning.definition import Definition
from sb3_sparse.tuning.spaces import check_space
from sb3_sparse.zoo.spec import RunSpec

DECAY = [0.0, 1e-6, 1e-4, 1e-3]
INTERVAL = [100, 250, 500, 1000, 5000]
DROP = [0.0, 0.1, 0.2, 0.3, 0.5]
INIT = [True, False]


@pytest.mark.parametrize(
    ("method", "grid", "cells"),
    [
        ("dense", dict(weight_decay=DECAY), 4),
        ("static", dict(weight_decay=DECAY, sparsity_aware_init=INIT), 8),
        ("prune", dict(weight_decay=DECAY, update_interval=INTERVAL), 20),
        *(
            (
                method,
                dict(
                    weight_decay=DECAY,
                    update_interval=INTERVAL,
                    drop_fraction=DROP,
                    sparsity_aware_init=INIT,
                ),
                200,
            )
            for method in ("set", "rigl", "granet", LeastIndex.name)
        ),
    ],
)
def test_the_papers_grid_has_what_the_method_has(method, grid, cells):
    space = paper_space(method)
    assert space.grid == grid
    if method == LeastIndex.name:
        return  # no config is shipped for it
    definition = Definition(small_run(method=method), space, 1, "grid", "none")
    assert definition.trials(None) == cells


def wide(**run) -> dict[str, str]:
    space = space_of("wide", small_run(**run))
    return {name: str(distribution) for name, distribution in space.distributions.items()}


def test_the_wide_space_is_continuous_and_has_what_method_and_policy_have():
    sac = wide(algo="sac", env_id="Pendulum-v1", method="rigl", sparsity=0.9)
    assert sac.keys() == {
        "weight_decay", "learning_rate", "update_interval", "drop_fraction", "distribution",
        "actor_share",
    }  # fmt: skip
    for name in ("weight_decay", "learning_rate", "update_interval"):
        assert "log=True" in sac[name]
    assert wide(method="rigl").keys() == sac.keys() - {"actor_share"}  # DQN has no actor
    dense = wide(algo="sac", env_id="Pendulum-v1", method="dense")
    assert dense.keys() == {"weight_decay", "learning_rate"}
    prune = wide(algo="ppo", env_id="CartPole-v1", method="prune", hyperparams={})
    assert prune.keys() == sac.keys() - {"drop_fraction"}


@pytest.mark.parametrize("sparsity", [0.05, 0.3, 0.6, 0.95])
def test_every_actor_share_of_the_wide_space_is_feasible(sparsity):
    run = small_run(algo="sac", env_id="Pendulum-v1", sparsity=sparsity, hyperparams={})
    share = space_of("wide", run).distributions["actor_share"]
    # Hidden layers of 256: actor 3·256 + 256² + 2·256, each of two critics 4·256 + 256² + 256.
    actor, critics = 768 + 65536 + 512, 2 * (1024 + 65536 + 256)
    budget = (1 - sparsity) * (actor + critics)
    for value in (share.low, share.high):
        assert value * budget <= actor
        assert (1 - value) * budget <= critics
    assert share.low < share.high


YAML = """
weight_decay: [0.0, 1.0e-4]
update_interval: {low: 100, high: 5000, log: true}
drop_fraction: {low: 0.0, high: 0.5, step: 0.1}
"""
MAPPING = "space = {'weight_decay': [0.0, 1e-4], 'gamma': {'low': 0.9, 'high': 0.999}}"
FUNCTION = """
def space(trial):
    width = trial.suggest_categorical("width", [8, 16])
    return {"net_arch": [width, width], "learning_rate": trial.suggest_float("lr", 1e-4, 1e-3)}
"""


@pytest.mark.parametrize(
    ("name", "text", "kinds"),
    [
        ("mine.yml", YAML, ["CategoricalDistribution", "IntDistribution", "FloatDistribution"]),
        ("mine.py", MAPPING, ["CategoricalDistribution", "FloatDistribution"]),
    ],
)
def test_a_space_of_ones_own(tmp_path, name, text, kinds):
    (tmp_path / name).write_text(text)
    space = space_of(str(tmp_path / name), small_run())
    assert space.name == "mine"
    assert [type(d).__name__ for d in space.distributions.values()] == kinds
    assert space.grid is None
    assert Space.from_dict(space.as_dict()) == space


def test_a_function_may_search_what_depends_on_other_values(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(FUNCTION)
    space = space_of(str(path), small_run())
    path.unlink()  # workers elsewhere do not have it
    space = Space.from_dict(space.as_dict())
    values = space.sample(optuna.trial.FixedTrial({"width": 8, "lr": 5e-4}))
    assert values == {"net_arch": [8, 8], "learning_rate": 5e-4}
    check_space(space, RunSpec(n_timesteps=3000))


@pytest.mark.parametrize(
    ("run", "space", "message"),
    [
        ({}, dict(weight_decai=[0.0]), "has no hyperparameter 'weight_decai' .did you mean"),
        ({}, dict(n_timesteps=[10, 20]), "trials are compared at equal numbers of steps"),
        (
            dict(hyperparams={"n_envs": 2}),
            dict(n_envs=[1, 2]),
            "varies n_envs, which is also fixed",
        ),
        (
            dict(hyperparams={"sparsity": 0.5}),
            dict(sparsity=[0.5, 0.9]),
            "which is also fixed to 0.5",
        ),
        (dict(n_envs=2), dict(n_envs=[1, 2]), "varies n_envs, which is also fixed to 2"),
        ({}, dict(distribution=["erk", "banana"]), "banana"),
        ({}, dict(weight_decay=[0.0, "1e-4"]), "weight_decay is the text '1e-4'"),
        ({}, dict(drop_fraction=[0.1, 1.5]), "drop_fraction"),
        ({}, dict(sparsity=[0.5, 1.0]), r"sparsity.*1.0"),
        (dict(method="static"), dict(update_interval=[1]), "'static' has no update_interval"),
        (dict(method="prune"), dict(drop_fraction=[0.1]), "'prune' has no drop_fraction"),
        (dict(method="dense"), dict(drop_fraction=[0.1]), "'dense' has no drop_fraction"),
        (dict(method="dense"), dict(distribution=["erk"]), "'dense' has no distribution"),
        (dict(sparsity=0.8), dict(sparsity=[0.5, 0.9]), "varies sparsity, which is also fixed to"),
        (dict(hyperparams={"gamma": 0.5}), dict(gamma=[0.9]), "varies gamma, which is also fixed"),
    ],
)
def test_a_space_that_the_run_has_no_place_for_is_refused(run, space, message):
    run = RunSpec(**{"n_timesteps": 3000, **run})
    with pytest.raises(ConfigError, match=message):
        check_space(choices(**space), run)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.yml", "{}", "the search space 'a' is empty"),
        ("a.yml", "", "must map hyperparameters to choices, got None"),
        ("a.yml", "weight_decay: []", "weight_decay in a.yml: .*one or more"),
        ("a.yml", "weight_decay: 3", "weight_decay in a.yml must be a list of choices, or a range"),
        ("a.yml", "gamma: {low: 1.0}", "gamma in a.yml must be .* a range {low: 0.1, high: 0.5}"),
        ("a.yml", "gamma: {low: 1e-6, high: 1}", "YAML reads 1e-6 as text; write 1.0e-6"),
        ("a.yml", "gamma: {low: 0, high: 1, foo: 1}", "log: true or step: 0.1 may be added"),
        ("a.yml", "gamma: {low: 1.0, high: 0.5}", "gamma in a.yml: .*low.*high"),
        ("a.py", "x = 1", "a.py must define `space`"),
        ("a.py", "space = {}", "the search space 'a' is empty"),
        ("a.py", "1 / 0", "a.py fails: ZeroDivisionError"),
        ("a.py", "space = lambda trial: 1 / 0", r"space\(trial\) in a fails: ZeroDivisionError"),
        (
            "a.py",
            "def space(trial):\n"
            "    good = trial.suggest_categorical('good', [True, False])\n"
            "    return {'gamma': 0.9} if good else {'colour': 1}\n",
            "has no hyperparameter 'colour'",
        ),
        ("a.py", "space = lambda trial: {}", r"space\(trial\) in a must return the sampled values"),
        ("a.txt", "", "unknown search space '.*a.txt'; allowed are paper, wide, or a file"),
    ],
)
def test_mistakes_in_a_file(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError, match=message):
        check_space(space_of(str(tmp_path / name), small_run()), small_run())


@pytest.mark.parametrize("name", ["none.yml", "none.py"])
def test_a_file_that_is_not_there(name):
    with pytest.raises(ConfigError, match=f"there is no .*{name}"):
        space_of(name, small_run())


def definition(space=None, **changes):
    values = dict(seeds=1, sampler="grid", pruner="none")
    return Definition(small_run(), space or paper_space("rigl"), **{**values, **changes})


def ranges() -> Space:
    of = optuna.distributions.FloatDistribution
    return Space("ranges", {"weight_decay": of(1e-6, 1e-3, log=True)})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: definition(sampler="cma"), "unknown sampler 'cma'; allowed are grid, tpe, random"),
        (
            lambda: definition(pruner="x"),
            "unknown pruner 'x'; allowed are none, median, halving, h",
        ),
        (lambda: definition(ranges()), "a grid needs choices, and the space 'ranges' has ranges"),
        (lambda: definition().trials(0), "at most 200, the cells of the grid; got 0"),
        (lambda: definition().trials(201), "at most 200, the cells of the grid; got 201"),
        (lambda: definition(ranges(), sampler="tpe").trials(0), "as many as you like; got 0"),
    ],
)
def test_what_does_not_go_together(make, message):
    with pytest.raises(ConfigError, match=message):
        make()


def test_a_sparsity_that_is_searched_is_no_part_of_the_name():
    assert definition().default_name == "dqn_CartPole-v1_rigl_0.9_paper"
    of = optuna.distributions.FloatDistribution
    searched = definition(Space("mine", {"sparsity": of(0.5, 0.9)}), sampler="tpe")
    assert searched.default_name == "dqn_CartPole-v1_rigl_mine"


def test_how_many_trials_unless_one_says_so():
    assert definition().trials(None) == 200
    assert definition().trials(7) == 7
    assert definition(ranges(), sampler="tpe").trials(None) == 100


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("learning_rate: {low: .nan, high: 0.1}", "learning_rate in .*(finite|nan)"),
        ("learning_rate: {low: 0.001, high: .inf}", "must lie between finite numbers"),
        ("learning_rate: {low: -.inf, high: 0.1}", "must lie between finite numbers"),
        ("learning_rate: {low: 0.001, high: 0.1, step: .nan}", "learning_rate in "),
        ("weight_decay: [0.0, .nan]", "weight_decay in .* has the choice nan"),
        ("weight_decay: [0.0, 1.0e-4, 0.0]", "has the choice 0.0 twice.*--seeds"),
        ("net_arch: [[8], [16], [8]]", r"has the choice \[8\] twice"),
    ],
)
def test_bounds_and_choices_that_are_no_numbers_or_stand_twice_are_refused(text, message, tmp_path):
    (tmp_path / "mine.yml").write_text(text + "\n")
    with pytest.raises(ConfigError, match=message):
        space_of(str(tmp_path / "mine.yml"), small_run(hyperparams={}))


def test_the_same_holds_for_spaces_made_in_python():
    ranges = optuna.distributions.FloatDistribution
    with pytest.raises(ConfigError, match="must lie between finite numbers"):
        Space("mine", {"learning_rate": ranges(0.1, float("inf"))})
    space = Space("mine", code="def space(trial):\n    return {'learning_rate': float('nan')}")
    with pytest.raises(ConfigError, match="gives learning_rate the value nan"):
        check_space(space, small_run())


def test_true_and_one_are_two_choices():
    assert choices(batch_size=[1, True]).grid == {"batch_size": [1, True]}
