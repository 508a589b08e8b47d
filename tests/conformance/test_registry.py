"""A registered algorithm is known wherever algorithms are told apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import stable_baselines3
from support import ALGORITHMS, make

from sb3_sparse import PassCounts, SparseDQNPolicy, SparseSACPolicy, register_policy
from sb3_sparse.algorithms.table import algorithm_named, nearest
from sb3_sparse.analysis import flops, gradient_snr, register_losses
from sb3_sparse.analysis import losses as losses_module
from sb3_sparse.analysis.flops import passes_of
from sb3_sparse.analysis.losses import losses_for
from sb3_sparse.errors import ConfigError
from sb3_sparse.export.extract import check_model, graph_of
from sb3_sparse.policies import registry
from sb3_sparse.policies.registry import CONTRIB, SB3, algorithm_names, registered
from sb3_sparse.zoo.configs import METHODS, config_path, evaluation_of
from sb3_sparse.zoo.saved_by import algos_of
from sb3_sparse.zoo.spec import algorithms

ROOT = Path(__file__).parents[2]
WITHOUT_STEPS = {"TRPO"}  # a line search has no fixed number of passes
WITHOUT_SNR = {"A2C", "CrossQ", "DDPG", "QRDQN", "TD3", "TQC", "TRPO"}
NAMES = algorithm_names()


def test_the_names_are_those_that_modules_register():
    assert NAMES == [*SB3, *CONTRIB] == list(registered())


@pytest.mark.parametrize("name", NAMES)
def test_commands_and_aliases_know_it(name):
    one = registered()[name]
    assert one.algorithm is ALGORITHMS[name]
    assert issubclass(algorithm_named(name), one.algorithm)
    assert algorithms()[name.lower()] is algorithm_named(name)
    for algorithm in (one.algorithm, algorithm_named(name)):
        assert algorithm.policy_aliases["SparsePolicy"] is one.policy
        assert issubclass(algorithm.policy_aliases["MlpPolicy"], one.stock_policy)


@pytest.mark.parametrize("name", NAMES)
def test_a_file_tells_that_it_is_of_it(name, tmp_path):
    for policy in ("SparsePolicy", "SparseMlpPolicy", "MlpPolicy"):
        make(name, policy=policy).save(tmp_path / "model.zip")
        assert algos_of(tmp_path / "model.zip")[0] == ("td3" if name == "DDPG" else name.lower())
        assert name.lower() in algos_of(tmp_path / "model.zip")


@pytest.mark.parametrize("name", NAMES)
def test_its_policy_says_where_it_acts_and_what_acts(name):
    model = make(name)
    assert isinstance(model.action_space, registered()[name].policy.action_spaces)
    check_model(model)
    graph = graph_of(model, None)
    shape = (20, *model.observation_space.shape)
    observations = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    found = graph.values(observations)[-1]
    expected, _ = model.predict(observations, deterministic=True)
    np.testing.assert_allclose(found.reshape(expected.shape), expected, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_its_gradient_steps_are_counted_or_said_not_to_be(name):
    model = make(name)
    if name in WITHOUT_STEPS:
        with pytest.raises(ConfigError, match=f"how often {name} runs its networks"):
            flops(model)
        return
    report = flops(model)
    for network in model.policy.networks:
        assert report.step(network) > report.forward(network)


@pytest.mark.parametrize("name", NAMES)
def test_its_snr_is_measured_or_said_not_to_be(name):
    model = make(name).learn(40)
    if name in WITHOUT_SNR:
        with pytest.raises(ConfigError, match=f"gradient_snr has no loss of {name}"):
            gradient_snr(model)
        return
    assert {one.network for one in gradient_snr(model).networks} == set(model.policy.networks)


@pytest.mark.parametrize("name", NAMES)
def test_it_has_configs_and_a_place_in_the_documents(name):
    for method in METHODS:
        assert config_path(method, name.lower()).is_file()
    assert evaluation_of(name.lower(), "CartPole-v1", False)["eval_freq"] > 0
    assert name in (ROOT / "docs/arguments.md").read_text()


class InheritingSAC(stable_baselines3.SAC):
    """SAC with the train() of its base class."""


def test_what_is_registered_for_a_subclass_is_not_its_base_classes(monkeypatch):
    monkeypatch.setattr(registry, "_registered", dict(registry.registered()))
    monkeypatch.setattr(losses_module, "_losses", dict(losses_module._losses))
    before = losses_for(stable_baselines3.SAC)
    assert losses_for(InheritingSAC) is before
    counts = [PassCounts("actor", 7, 7)]

    @register_policy(InheritingSAC, passes=lambda model: counts)
    class Policy(SparseSACPolicy):
        """SAC's, under another name."""

    @register_losses(InheritingSAC)
    def losses(model, policy, batch):
        return []

    assert losses_for(InheritingSAC) is losses
    assert losses_for(stable_baselines3.SAC) is before
    assert nearest(InheritingSAC, {stable_baselines3.SAC: 1}) == 1
    model = InheritingSAC(Policy, "Pendulum-v1", policy_kwargs=dict(sparsity=0.5))
    assert passes_of(model) == counts


def test_a_policy_may_give_the_sparse_arguments_itself():
    class Narrow(SparseDQNPolicy):
        """Has one argument of its own."""

        def __init__(self, observation_space, action_space, lr_schedule, width=16):
            super().__init__(
                observation_space, action_space, lr_schedule, sparsity=0.5, net_arch=[width]
            )

    model = stable_baselines3.DQN(Narrow, "CartPole-v1", policy_kwargs=dict(width=8))
    assert model.policy.sparsity_report().layers[0].shape == (8, 4)
