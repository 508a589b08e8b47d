"""An algorithm that a user registers in one file works in every command."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest
import stable_baselines3
import torch as th
import yaml
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_sparse import SAC, SparseSACPolicy, register_policy, sparsify
from sb3_sparse.analysis import Loss, flops, gradient_snr, register_losses
from sb3_sparse.analysis.losses import _losses, losses_for
from sb3_sparse.errors import ConfigError
from sb3_sparse.export import export_policy
from sb3_sparse.policies import registry
from sb3_sparse.zoo.inspection import inspect_model
from sb3_sparse.zoo.saved import SavedModel
from sb3_sparse.zoo.scoring import enjoy
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.training import train

CONFIG = {
    "n_timesteps": 120,
    "policy": "sb3_sparse.SparsePolicy",
    "learning_starts": 40,
    "batch_size": 16,
    "caution": 0.2,
    "ent_coef": "auto_0.1",  # as SAC's own may be
    "policy_kwargs": {"sparsity": 0.8, "net_arch": {"pi": [16, 16], "qf": [16, 16]}},
    "callback": [{"sb3_sparse.SparsityCallback": {"method": "rigl", "update_interval": 20}}],
}


def forget() -> None:
    """As in a new process: nobody has registered the algorithm."""
    registry._registered.pop("CautiousSAC", None)
    sys.modules.pop("my_algorithms", None)


@pytest.fixture(autouse=True)
def fresh():
    forget()
    yield
    forget()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder of a run of it."""
    where = tmp_path_factory.mktemp("logs")
    (where / "mine.yml").write_text(yaml.safe_dump({"Pendulum-v1": CONFIG}))
    run = RunSpec(
        "cautioussac",
        "Pendulum-v1",
        gym_packages="my_algorithms",
        conf_file=str(where / "mine.yml"),
        eval_episodes=1,
    )
    outcome = train(run, where)
    assert outcome.finished
    assert outcome.model.policy.sparse.networks[0].mask_updates > 0
    return outcome.folder


def test_it_is_trained_and_its_folder_says_all_that_loading_needs(folder):
    assert (folder.parent.name, folder.name) == ("cautioussac", "Pendulum-v1_1")
    saved = SavedModel.find(folder)
    model = saved.load()
    assert (saved.algo, type(model).__name__, model.caution) == ("cautioussac", "CautiousSAC", 0.2)
    assert enjoy(folder, episodes=1).episodes == 1


def test_it_is_looked_into_without_running_it(folder):
    assert "actor.first.0" in str(inspect_model(folder))
    assert "my_algorithms" not in sys.modules


def test_its_gradient_step_is_counted(folder):
    report = flops(SavedModel.find(folder).load())
    assert report.algorithm == "CautiousSAC"
    layers = {layer.name: layer for layer in report.layers}
    first = layers["actor.first.0"]
    assert first.step == (2 + 2) * 16 * first.forward  # two forward and one backward pass


def test_its_snr_is_measured_once_it_has_losses(folder):
    model = SavedModel.find(folder).load()
    space = model.observation_space
    observations = th.rand(8, *space.shape)
    batch = ReplayBufferSamples(
        observations, th.rand(8, 1), observations, th.zeros(8, 1), th.rand(8, 1)
    )
    with pytest.raises(ConfigError, match="gradient_snr has no loss of CautiousSAC"):
        gradient_snr(model, batch)

    def of_actor(policy, sample):
        mean, log_std, _ = policy.actor.get_action_dist_params(sample["observations"][None])
        return (mean + log_std).sum()

    def of_critic(policy, sample):
        return policy.critic(sample["observations"][None], sample["actions"][None])[0].sum()

    @register_losses(type(model))
    def losses(model, policy, batch):
        samples = dict(observations=batch.observations, actions=batch.actions)
        return [Loss(("actor",), samples, of_actor), Loss(("critic",), samples, of_critic)]

    assert losses_for(stable_baselines3.SAC) is not losses
    try:
        assert gradient_snr(model, batch)["actor"].active > 0
    finally:
        _losses.pop(type(model))


def test_it_is_exported_and_a_sparser_twin_of_it_is_made(folder, tmp_path):
    model = SavedModel.find(folder).load()
    for to in ("numpy", "c", "onnx"):
        assert export_policy(model, tmp_path / "policy", to).parity.holds
    twin = sparsify(model, 0.9)
    assert type(twin) is type(model)
    assert twin.policy.sparse.sparsity > model.policy.sparse.sparsity


def test_a_zip_elsewhere_tells_its_algorithm(folder, tmp_path):
    (tmp_path / "model.zip").write_bytes((folder / "Pendulum-v1.zip").read_bytes())
    assert SavedModel.find(tmp_path / "model.zip").algo == "cautioussac"


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["--algo", "cautioussac"], "unknown algorithm 'cautioussac'.*--gym-packages names"),
        (
            ["--algo", "cautioussac", "--gym-packages", "my_algorithms"],
            "no config is shipped for 'cautioussac'.*pass it as --conf-file",
        ),
        (
            ["--algo", "cautioussac", "--gym-packages", "my_algorithms"]
            + ["--env", "CartPole-v1", "--conf-file", "mine.yml"],
            "cautioussac cannot act in CartPole-v1.*use dqn or ppo or a2c or qrdqn or trpo",
        ),
    ],
)
def test_commands_say_what_is_missing(args, said, mistake, tmp_path):
    (tmp_path / "mine.yml").write_text(yaml.safe_dump({"CartPole-v1": CONFIG}))
    line = mistake("train", "--env", "Pendulum-v1", *args)
    assert re.search(said, line), line


def test_a_name_that_is_taken_is_rejected():
    class Sac(SAC):
        """Another one."""

    with pytest.raises(ConfigError, match="the algorithm name 'SAC' is taken by stable_baselines3"):
        register_policy(Sac)(SparseSACPolicy)


def test_registering_a_subclass_leaves_the_policies_of_its_base_class_alone():
    import my_algorithms

    before = dict(stable_baselines3.SAC.policy_aliases)
    assert my_algorithms.CautiousSAC.policy_aliases["SparsePolicy"] is my_algorithms.CautiousPolicy
    assert before["SparsePolicy"] is SparseSACPolicy
    assert stable_baselines3.SAC.policy_aliases == before


def test_an_error_inside_sb3_contrib_does_not_read_as_if_it_were_not_installed(tmp_path):
    (tmp_path / "sb3_contrib").mkdir()
    (tmp_path / "sb3_contrib" / "__init__.py").write_text("import a_library_that_is_missing")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import sb3_sparse"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "No module named 'a_library_that_is_missing'" in done.stderr.splitlines()[-1]


def test_an_algorithm_without_a_class_of_ours_says_which_one_to_take():
    import sb3_sparse

    with pytest.raises(AttributeError, match="sb3_contrib.TRPO takes SparsePolicy"):
        sb3_sparse.TRPO  # noqa: B018
