"""Environments of one's own: named by their package, remembered by runs, imported by workers."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import pytest
import yaml

from sb3_sparse.cli.common import run_spec
from sb3_sparse.compress import compress_model
from sb3_sparse.errors import ConfigError
from sb3_sparse.export import export_policy
from sb3_sparse.launch import launcher_named
from sb3_sparse.report import write_report
from sb3_sparse.studies import Study, run_study, status_of
from sb3_sparse.tuning import tune
from sb3_sparse.tuning.backend import optuna
from sb3_sparse.tuning.spaces import Space
from sb3_sparse.zoo.card import Card
from sb3_sparse.zoo.environments import import_packages, plain_id
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.inspection import inspect_model
from sb3_sparse.zoo.saved import SavedModel
from sb3_sparse.zoo.scoring import enjoy
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.training import resume, train

SOURCE = """
import gymnasium as gym
from gymnasium.envs.classic_control import CartPoleEnv

class Tiny(CartPoleEnv):
    pass

class Blind(CartPoleEnv):
    def __init__(self):
        super().__init__()

for name in ("Tiny-v0", "ours/Tiny-v0"):
    gym.register(name, entry_point="tiny_envs:Tiny", max_episode_steps=20)
gym.register("Blind-v0", entry_point="tiny_envs:Blind", max_episode_steps=20)
"""
SHORT = dict(
    n_timesteps=200,
    eval_freq=100,
    eval_episodes=1,
    hyperparams={"net_arch": [8], "learning_starts": 50, "batch_size": 16, "buffer_size": 500},
)


def forget() -> None:
    """As in a new process: the package was never imported."""
    sys.modules.pop("tiny_envs", None)
    for name in ("Tiny-v0", "ours/Tiny-v0", "Blind-v0"):
        gym.registry.pop(name, None)


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """Folder with the package ``tiny_envs``, which is on this process's path alone."""
    folder = tmp_path_factory.mktemp("package")
    (folder / "tiny_envs.py").write_text(SOURCE)
    sys.path.append(str(folder))
    yield folder
    sys.path.remove(str(folder))
    forget()


@pytest.fixture(autouse=True)
def fresh(package):
    forget()


@pytest.fixture(scope="module")
def trained(package, tmp_path_factory):
    """Folder of a run."""
    forget()
    return train(
        RunSpec(env_id="tiny_envs:Tiny-v0", **SHORT), tmp_path_factory.mktemp("logs")
    ).folder


def test_a_run_remembers_the_package_and_lies_in_a_folder_of_the_plain_id(trained):
    assert (trained.parent.name, trained.name) == ("dqn", "Tiny-v0_1")
    assert (trained / "Tiny-v0.zip").is_file()
    arguments = RunFolder(trained).arguments()
    assert (arguments["env"], arguments["gym_packages"]) == ("Tiny-v0", ["tiny_envs"])


def test_a_card_names_the_package_that_its_readers_need(trained):
    assert "Python must find `tiny_envs`" in str(Card.of(trained))


def test_an_environment_that_does_not_render_is_not_filmed_and_what_it_lacks_is_said(trained):
    with pytest.raises(ConfigError, match=r"For a video .* take render_mode='rgb_array'"):
        enjoy(trained, env_id="tiny_envs:Blind-v0", episodes=1, video=True)
    assert enjoy(trained, env_id="tiny_envs:Blind-v0", episodes=1).episodes == 1


@pytest.mark.parametrize(
    ("env_id", "packages", "plain"),
    [
        ("tiny_envs:Tiny-v0", (), "Tiny-v0"),
        ("Tiny-v0", ("tiny_envs",), "Tiny-v0"),
        ("Tiny-v0", "tiny_envs", "Tiny-v0"),
        ("tiny_envs:ours/Tiny-v0", ["tiny_envs"], "ours/Tiny-v0"),
    ],
)
def test_both_ways_to_name_a_package_are_one(package, env_id, packages, plain):
    run = RunSpec(env_id=env_id, gym_packages=packages, **SHORT)
    assert (run.env_id, run.gym_packages) == (plain, ("tiny_envs",))
    assert RunSpec(**run.as_dict()) == run
    assert "gym_packages" not in RunSpec(**SHORT).as_dict()  # as files written before have it


def test_a_run_that_reaches_another_process_imports_its_package_there(package):
    run = RunSpec(env_id="tiny_envs:Tiny-v0", **SHORT)
    content = pickle.dumps(run)
    forget()
    assert pickle.loads(content) == run
    assert "Tiny-v0" in gym.registry


def test_a_run_is_watched_exported_and_made_sparser_by_its_folder_alone(trained, tmp_path):
    assert enjoy(trained, episodes=2).mean_return <= 20
    forget()
    saved = SavedModel.find(trained)
    envs = saved.evaluation_envs(1, 0)
    export_policy(saved.load(), tmp_path / "policy", "numpy")
    assert (tmp_path / "policy.npz").is_file()
    forget()
    training = saved.training_envs(1, 0)
    compress_model(
        saved.load(training), envs, tmp_path / "out", sparsity=0.95, steps=100, episodes=2
    )
    saved.write_run_files(tmp_path / "out")
    assert RunFolder(tmp_path / "out").arguments()["gym_packages"] == ["tiny_envs"]


def test_looking_into_a_model_imports_nothing(trained):
    inspect_model(trained)
    assert "tiny_envs" not in sys.modules


def test_a_model_is_exported_where_the_package_of_its_environment_is_missing(
    trained, package, tmp_path, monkeypatch
):
    monkeypatch.setattr(sys, "path", [one for one in sys.path if one != str(package)])
    export_policy(SavedModel.find(trained).load(), tmp_path / "policy", "numpy")
    with pytest.raises(ConfigError, match="there is no package 'tiny_envs'"):
        enjoy(trained, episodes=1)


def test_a_zip_elsewhere_takes_the_package_from_the_environments_id(trained, tmp_path):
    elsewhere = tmp_path / "model.zip"
    elsewhere.write_bytes((trained / "Tiny-v0.zip").read_bytes())
    for given in (
        dict(env_id="tiny_envs:Tiny-v0"),
        dict(env_id="Tiny-v0", gym_packages=["tiny_envs"]),
    ):
        forget()
        saved = SavedModel.find(elsewhere, **given)
        assert saved.env_id == "Tiny-v0"
        saved.evaluation_envs(1, 0).close()
    saved.write_run_files(tmp_path / "run")
    assert RunFolder(tmp_path / "run").arguments()["gym_packages"] == ["tiny_envs"]


def test_an_interrupted_run_goes_on_in_a_new_process(package, tmp_path):
    folder = train(RunSpec(env_id="tiny_envs:Tiny-v0", **SHORT), tmp_path).folder
    RunFolder(folder).write(status="evaluating", trained=True)
    forget()
    assert resume(folder).finished


def test_a_run_that_rl_zoo_made_is_watched(package, tmp_path):
    config = {
        "Tiny-v0": {
            "policy": "SparsePolicy",
            "n_timesteps": 300,
            "learning_starts": 50,
            "policy_kwargs": {"sparsity": 0.5, "net_arch": [8]},
            "callback": {"sb3_sparse.SparsityCallback": {"method": "static"}},
        }
    }
    (tmp_path / "config.yml").write_text(yaml.safe_dump(config))
    command = [sys.executable, "-m", "rl_zoo3.train", "--algo", "dqn", "--env", "Tiny-v0"]
    command += ["--gym-packages", "tiny_envs", "--conf-file", "config.yml", "--eval-freq", "-1"]
    path = os.pathsep.join([str(package), str(Path(__file__).parents[2])])
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, check=True)
    (folder,) = (tmp_path / "logs" / "dqn").glob("Tiny-v0_*")
    assert enjoy(folder, episodes=1).episodes == 1
    forget()
    SavedModel.find(folder).evaluation_envs(1, 0).close()


def test_workers_of_a_tuning_import_it(package, tmp_path):
    space = Space("s", {"gamma": optuna.distributions.CategoricalDistribution([0.9])})
    tuned = tune(RunSpec(env_id="tiny_envs:Tiny-v0", **SHORT), space, log_folder=tmp_path)
    assert tuned.status.finished, tuned.errors
    assert tuned.study.study_name == "dqn_Tiny-v0_rigl_0.9_s"


@pytest.mark.parametrize("named", ["by id", "in the file", "by the caller"])
def test_studies_name_it_too(named, package, tmp_path):
    env_id = "tiny_envs:Tiny-v0" if named == "by id" else "Tiny-v0"
    common = {"algo": "dqn", "env_id": [env_id], **SHORT}
    if named == "in the file":
        common["gym_packages"] = ["tiny_envs"]
    content = {"title": "T", "figures": ["curves"], "common": common}
    content |= {"runs": [{"method": "dense"}], "scales": {"smoke": {}}}
    (tmp_path / "mine.yml").write_text(yaml.safe_dump(content))
    given = ["tiny_envs"] if named == "by the caller" else []
    study = Study.read(str(tmp_path / "mine.yml"), "smoke", given)
    (cell,) = study.cells
    assert cell.run == RunSpec(algo="dqn", env_id="tiny_envs:Tiny-v0", method="dense", **SHORT)
    if named == "in the file":
        *_, last = run_study(study, tmp_path / "store", launcher_named("local"), 1)
        assert (last.done, last.failed) == (1, {})
        forget()
        folders = [status_of(cell, tmp_path / "store").folder.path]
        assert write_report(folders, tmp_path / "out", title="T", figures=["curves"]).is_file()


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("nowhere_envs:Tiny-v0", "there is no package 'nowhere_envs' .* PYTHONPATH"),
        ("broken_envs:Tiny-v0", "'broken_envs' cannot be imported: RuntimeError: no licence"),
        ("needy_envs:Tiny-v0", "'needy_envs' cannot be imported: ModuleNotFoundError: .*'absent'"),
        ("a/b.py:Tiny-v0", "'a/b.py:Tiny-v0' is neither an id nor package:Id"),
        ("tiny_envs:", "is neither an id nor package:Id"),
        ("tiny_envs:a:b", "is neither an id nor package:Id"),
        ("tiny_envs:Tinny-v0", "unknown environment 'Tinny-v0'.*did you mean 'Tiny-v0'"),
        ("Tiny-v0", "unknown environment 'Tiny-v0'.*your own is module:Id.* --gym-packages names"),
    ],
)
def test_what_is_wrong_with_a_package_is_said(env_id, message, package):
    (package / "broken_envs.py").write_text("raise RuntimeError('no licence')")
    (package / "needy_envs.py").write_text("import absent")
    with pytest.raises(ConfigError, match=message):
        RunSpec(env_id=env_id)


@pytest.mark.parametrize("given", [3, ["a.py/b"], ["my envs"], [3], {"a": 1}])
def test_packages_that_are_no_names_of_modules_are_refused(given):
    with pytest.raises(ConfigError, match="gym_packages must be names of modules"):
        RunSpec(gym_packages=given)


def test_a_package_in_this_folder_is_found_by_saying_so(tmp_path, monkeypatch):
    (tmp_path / "here_envs.py").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [one for one in sys.path if one not in ("", str(tmp_path))])
    with pytest.raises(ConfigError, match="PYTHONPATH=. before the command"):
        import_packages(["here_envs"])


def test_ids_without_a_package_stay_as_they_are():
    assert plain_id("ALE/Pong-v5") == ("ALE/Pong-v5", ())


def spec_of(words, values, packages):
    return run_spec(SimpleNamespace(args=words), "dqn", "CartPole-v1", values, packages)


def test_several_words_follow_gym_packages_and_hyperparams_in_any_order():
    words = ["gamma:0.9", "json", "tau:0.5"]
    spec = spec_of(words, ["batch_size:8"], ["colorsys"])
    assert spec.hyperparams == {"batch_size": 8, "gamma": 0.9, "tau": 0.5}
    assert spec.gym_packages == ("colorsys", "json")
    for words, values, packages in ((["x"], [], []), (["batch_size:1"], [], ["colorsys"])):
        with pytest.raises(ConfigError, match="unexpected argument"):
            spec_of(words, values, packages)
