"""What belongs to a model is found, or missed aloud; nothing is written by looking."""

from __future__ import annotations

import shutil
import stat
from functools import partial

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from support import make, run_command

from sb3_sparse import sparsify
from sb3_sparse.errors import ConfigError, CorruptStateError, Diverged
from sb3_sparse.loading.statistics import load_statistics, read_statistics
from sb3_sparse.loading.text import read_text
from sb3_sparse.studies import Study
from sb3_sparse.zoo.inspection import inspect_model
from sb3_sparse.zoo.saved import SavedModel
from sb3_sparse.zoo.scoring import enjoy
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.training import train

ENV = "Pendulum-v1"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    settings = dict(normalize=True, n_steps=64, batch_size=32, net_arch=[8])
    quick = dict(n_timesteps=128, eval_freq=64, eval_episodes=1)
    run = RunSpec("ppo", ENV, "static", sparsity=0.5, hyperparams=settings, **quick)
    return train(run, tmp_path_factory.mktemp("logs")).folder


@pytest.fixture
def folder(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "run")


@pytest.fixture
def said(monkeypatch, capsys):
    return partial(run_command, monkeypatch, capsys)


def test_enjoy_plays_a_zip_alone_as_its_run(folder, tmp_path, said):
    in_run = enjoy(folder, 3)
    alone = shutil.copy(folder / f"{ENV}.zip", tmp_path / "alone.zip")
    statistics = shutil.copy(folder / ENV / "vecnormalize.pkl", tmp_path / "statistics.pkl")
    score = enjoy(alone, 3, env_id=ENV, vecnormalize=statistics)
    assert (score.mean_return, score.std_return) == (in_run.mean_return, in_run.std_return)
    code, out, _ = said(
        "enjoy", alone.with_suffix(""), "-n", 1, "--env", ENV, "--vecnormalize", statistics
    )
    assert code == 0
    assert "Policy:" in out
    assert str(alone) in out


def test_a_zip_in_a_run_is_played_with_all_that_belongs_to_it(folder):
    assert (
        enjoy(folder / "best_model.zip", 2).mean_return == enjoy(folder, 2, best=True).mean_return
    )


def test_a_zip_that_does_not_say_its_environment_asks_for_it(tmp_path, mistake):
    make("DQN").save(tmp_path / "model.zip")
    said = mistake("enjoy", "model.zip")
    assert "model.zip does not name its environment; give --env" in said
    said = mistake("enjoy", "model.zip", "--env", "Acrobot-v1")
    assert "model.zip does not suit Acrobot-v1: Observation spaces do not match" in said


@pytest.mark.parametrize("command", ["enjoy", "export", "compress"])
def test_a_run_without_its_config_is_never_taken_for_one_without_normalisation(
    command, folder, mistake
):
    (folder / ENV / "config.yml").unlink()
    said = mistake(command, str(folder))
    assert f"{ENV}/config.yml is missing, which records how the run's environment" in said
    given = SavedModel.find(folder, vecnormalize=folder / ENV / "vecnormalize.pkl")
    assert given.vecnormalize is not None


def test_statistics_that_the_config_denies_are_not_passed_over(folder, mistake):
    path = folder / ENV / "config.yml"
    path.write_text(
        path.read_text()
        .replace("normalize: true", "normalize: false")
        .replace("- - normalize\n    - true", "- - normalize\n    - false")
    )
    assert "config.yml nothing was normalised" in mistake("enjoy", str(folder))


def test_statistics_beside_a_lone_zip_are_not_passed_over(tmp_path):
    make("SAC").save(tmp_path / "model.zip")
    envs = VecNormalize(make_vec_env(ENV))
    envs.save(str(tmp_path / "vecnormalize.pkl"))
    with pytest.raises(ConfigError, match="is beside .*model.zip: give --vecnormalize"):
        SavedModel.find(tmp_path / "model.zip", env_id=ENV)
    statistics = tmp_path / "vecnormalize.pkl"
    assert (
        SavedModel.find(tmp_path / "model.zip", vecnormalize=statistics).vecnormalize == statistics
    )


def test_statistics_of_other_observations_are_refused(tmp_path):
    VecNormalize(make_vec_env("CartPole-v1")).save(str(tmp_path / "of_cartpole.pkl"))
    with pytest.raises(ConfigError, match=r"of shape \(4,\), but those here have shape \(3,\)"):
        load_statistics(tmp_path / "of_cartpole.pkl", make_vec_env(ENV))


def test_statistics_that_are_not_finite_are_said_to_be_so(tmp_path):
    envs = VecNormalize(make_vec_env(ENV))
    envs.obs_rms.mean[1] = np.nan
    envs.save(str(tmp_path / "nan.pkl"))
    with pytest.raises(Diverged, match=r"nan.pkl are not finite: the environment showed NaN"):
        read_statistics(tmp_path / "nan.pkl")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_network_that_is_not_finite_diverged_wherever_it_is_read(value, tmp_path, mistake):
    model = make("DQN", learning_starts=0)
    for weight in model.policy.q_net.q_net[2].parameters():
        weight.data.fill_(value)
    names = r"diverged: \d+ of 576 values of q_net.q_net.2.weight are not finite \(and 1 more"
    with pytest.raises(Diverged, match=names):
        sparsify(model, 0.95)
    model.save(tmp_path / "model.zip")
    for command in ("inspect", "enjoy", "export", "compress"):
        given = [] if command == "inspect" else ["--env", "CartPole-v1"]
        said = mistake(command, "model.zip", *given)
        assert "the training of model.zip diverged" in said
        assert "q_net.q_net.2.weight" in said
        assert "smaller learning rate" in said


def test_a_mask_that_contradicts_its_weight_is_still_told_apart(tmp_path):
    model = make("DQN")
    layer = model.policy.q_net.q_net[2]
    with th.no_grad():
        layer.weight.fill_(1.0)
    state = model.policy.state_dict()
    from sb3_sparse.loading.zips import check_state

    mask = state["q_net.q_net.2.weight_mask"]
    state["q_net.q_net.2.weight"] = th.ones_like(mask, dtype=th.float32)
    wrong = int((~mask).sum())
    with pytest.raises(CorruptStateError, match=f"{wrong} connections of q_net.q_net.2 are not 0"):
        check_state(state, "here")


def test_text_that_is_not_utf_8_is_refused_with_its_place(tmp_path):
    (tmp_path / "space.yml").write_bytes("a: 1\nname: Jürgen\n".encode("latin-1"))
    with pytest.raises(CorruptStateError, match=r"byte 0xfc in line 2\); save it as UTF-8"):
        read_text(tmp_path / "space.yml", "search space", "")
    (tmp_path / "marked.txt").write_text("a: 1", encoding="utf-8-sig")
    assert read_text(tmp_path / "marked.txt", "text", "") == "a: 1"


@pytest.mark.parametrize("name", ["[red]x[/]", "[/]", "a [bold", "[link=x]y"])
def test_markup_in_the_name_of_a_folder_is_printed_as_it_is(name, whole, tmp_path, said):
    path = shutil.copytree(whole, tmp_path / name)  # [/] is a folder in one called [
    code, out, err = said("enjoy", path, "-n", 1)
    assert code == 0, err
    assert str(path / f"{ENV}.zip") in out
    code, out, err = said("export", path, path / "policy", "--to", "numpy")
    assert code == 0, err
    assert str(path / "policy.npz") in out
    code, _, err = said("inspect", path / "gone.zip")
    assert str(path / "gone.zip") in err
    code, _, err = said(name)
    assert code == 2
    assert f"No such command {name!r}" in err


@pytest.fixture
def read_only(folder):
    """A run's folder in which nothing can be made; root may, so all is compared as well."""
    places = [folder, *(path for path in folder.rglob("*") if path.is_dir())]
    for path in places:
        path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    yield folder
    for path in places:
        path.chmod(stat.S_IRWXU)


def everything(folder):
    return {
        path: (path.stat().st_mtime_ns, path.stat().st_size)
        for path in [folder, *folder.rglob("*")]
    }


def test_looking_at_a_run_writes_nothing_into_it(read_only):
    before = everything(read_only)
    inspect_model(read_only)
    enjoy(read_only, 1)
    SavedModel.find(read_only).load()
    assert everything(read_only) == before


def test_looking_at_a_study_writes_nothing(tmp_path, said):
    study = tmp_path / "mine.yml"
    study.write_text(
        "title: mine\nfigures: [curves]\nruns: [{algo: dqn, env_id: CartPole-v1, method: static, "
        "sparsity: 0.5}]\nscales: {small: {seeds: 1, n_timesteps: 100, eval_freq: 50, "
        "eval_episodes: 1}}\n"
    )
    store = tmp_path / "store"
    cell = Study.read(str(study), "small").cells[0]
    code, out, _ = said("study", "status", study, "-f", store)
    assert code == 0
    assert "1 waiting" in out
    assert not store.exists()
    train(cell.run, folder=cell.folder(store).path)
    (cell.folder(store).path / ".lock").touch()  # of a process that was killed
    before = everything(store)
    code, out, _ = said("study", "status", study, "-f", store)
    assert code == 0
    assert "1 done" in out
    assert everything(store) == before
    record = cell.folder(store).path / "sparsity.json"
    record.write_bytes(record.read_bytes()[:40])
    code, out, _ = said("study", "status", study, "-f", store)
    assert code == 0
    assert "1 failed" in out
    assert "sparsity.json is damaged" in out
    code, out, err = said("study", "report", study, "-f", store, "-o", tmp_path / "page")
    assert code == 0, err
    assert "sparsity.json is damaged" in (tmp_path / "page" / "index.html").read_text()
