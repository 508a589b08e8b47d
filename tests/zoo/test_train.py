"""Runs called from Python: what they leave behind, and going on after an interruption."""

from __future__ import annotations

import errno
import json
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.envs.classic_control import PendulumEnv
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import load_results
from support import ALGORITHMS

from sb3_sparse.errors import ConfigError, CorruptStateError, Diverged, Unwritable
from sb3_sparse.zoo.ending import diverging
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.replay import BufferSaver, restore_buffer
from sb3_sparse.zoo.scoring import enjoy
from sb3_sparse.zoo.spec import RunSpec, algorithms
from sb3_sparse.zoo.training import resume, train
from sb3_sparse.zoo.watch import Watch

SMALL = {"net_arch": [16, 16], "batch_size": 16}
QUICK = dict(eval_freq=100, eval_episodes=2)
DQN_RUN = RunSpec(
    n_timesteps=500,
    hyperparams={**SMALL, "learning_starts": 50, "update_interval": 20},
    **QUICK,
)
PPO_RUN = RunSpec(
    algo="ppo",
    env_id="Pendulum-v1",
    method="set",
    n_timesteps=512,
    hyperparams={
        "net_arch": {"pi": [8, 8], "vf": [8, 8]},
        "n_steps": 64,
        "update_interval": 20,
        "drop_fraction": 0.3,
    },
    **QUICK,
)


class Stop(BaseCallback):
    """What a user's Ctrl-C, or ``kill``, does at some step."""

    def __init__(self, at: int, number: int = signal.SIGINT, times: int = 1) -> None:
        super().__init__()
        self.at, self.number, self.times = at, number, times

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            for _ in range(self.times):
                signal.raise_signal(self.number)
        return True


def evaluations(folder):
    with np.load(folder / "evaluations.npz") as saved:
        return saved["timesteps"].tolist(), saved["results"]


class Seen(Watch):
    """Notes what a run tells."""

    def __init__(self) -> None:
        super().__init__()
        self.folders, self.evaluations, self.episodes = [], [], []

    def begins(self, folder, match) -> None:
        self.folders.append((folder, match))

    def evaluated(self, step, mean, std, best) -> None:
        self.evaluations.append((step, mean, std, best))

    def plays(self, what, done, planned) -> None:
        self.episodes.append((what, done, planned))


@pytest.fixture(scope="module")
def seen():
    """What the finished run told."""
    return Seen()


@pytest.fixture(scope="module")
def finished(tmp_path_factory, seen):
    """The outcome of a run that nothing interrupts."""
    return train(DQN_RUN, tmp_path_factory.mktemp("logs"), watch=seen)


def test_the_folder_is_the_zoos_plus_sparsity_json(finished):
    folder = finished.folder
    assert folder.parts[-2:] == ("dqn", "CartPole-v1_1")
    assert sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()) == [
        "0.monitor.csv",
        "CartPole-v1.zip",
        "CartPole-v1/args.yml",
        "CartPole-v1/command.txt",
        "CartPole-v1/config.yml",
        "best_model.zip",
        "evaluations.npz",
        "sparsity.json",
    ]
    timesteps, results = evaluations(folder)
    assert timesteps == [100, 200, 300, 400, 500]
    assert results.shape == (5, 2)


def test_sparsity_json_says_what_was_trained_and_how_sparse_it_is(finished):
    record = json.loads((finished.folder / "sparsity.json").read_text())
    assert RunSpec(**record["run"]) == DQN_RUN
    assert (record["status"], record["method"], record["num_timesteps"]) == (
        "finished",
        "rigl",
        500,
    )
    assert record["settings"]["policy_kwargs"]["net_arch"] == [16, 16]
    assert record["evaluation"] == {"eval_freq": 100, "eval_episodes": 2}
    assert [result["path"] for result in record["results"]] == ["CartPole-v1.zip", "best_model.zip"]
    assert record["versions"]["torch"] == th.__version__
    masks = [layer.mask() for layer in finished.model.policy.sparse.layers]
    shapes = [[16, 4], [16, 16], [2, 16]]
    assert [layer["shape"] for layer in record["layers"]] == shapes
    assert [layer["nnz"] for layer in record["layers"]] == [int(mask.sum()) for mask in masks]
    nnz = sum(int(mask.sum()) for mask in masks)
    total = record["total"]
    assert total["nnz"] == nnz
    assert total["parameters"] == nnz + 16 + 16 + 2
    assert total["flops"] == 2 * nnz + (16 + 16 + 2) + (16 + 16)  # biases, activations
    assert total["dense_flops"] == 2 * (64 + 256 + 32) + (16 + 16 + 2) + (16 + 16)
    assert total["sparsity"] == pytest.approx(1 - nnz / 352)


def test_the_best_policy_of_pruning_is_pruned(tmp_path):
    hyperparams = {**SMALL, "update_interval": 20}
    run = RunSpec(
        method="prune", n_timesteps=1500, eval_freq=200, eval_episodes=2, hyperparams=hyperparams
    )
    outcome = train(run, tmp_path)
    assert len(evaluations(outcome.folder)[0]) == 7
    best = DQN.load(outcome.folder / "best_model.zip")
    assert best.num_timesteps > 0.8 * 1500
    for model in (best, outcome.model):
        assert all(layer.nnz == layer.final_nnz for layer in model.policy.sparse.layers)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(("run", "cls"), [(DQN_RUN, DQN), (PPO_RUN, PPO)])
def test_a_stopped_run_goes_on_and_evaluates_every_point_once(run, cls, number, tmp_path):
    handler = signal.getsignal(number)
    stopped = train(run, tmp_path, [Stop(250, number)])
    assert signal.getsignal(number) == handler
    assert not stopped.finished
    folder = stopped.folder
    record = RunFolder(folder).record()
    assert record["status"] == "interrupted"
    assert 250 <= record["num_timesteps"] < 350
    cls.load(folder / f"{run.env_id}.zip")
    before = evaluations(folder)
    assert before[0] == [t for t in range(100, 301, 100) if t <= record["num_timesteps"]]
    checkpoint = RunFolder(folder).last_checkpoint()
    saved = cls.load(checkpoint / f"{run.env_id}.zip")
    if cls is DQN:
        restore_buffer(saved.replay_buffer, checkpoint / "replay_buffer")
        assert saved.replay_buffer.size() == saved.num_timesteps
    else:
        assert saved.num_timesteps % 64 == 0  # whole rollouts, all learnt from

    assert saved.num_timesteps == record["num_timesteps"] == stopped.model.num_timesteps
    monitored = load_results(folder)
    first = Look()
    done = resume(folder, [first])
    assert done.finished
    assert done.folder == folder
    assert first.steps == saved.num_timesteps
    assert first.clocks == [network.clock for network in saved.policy.sparse.networks]
    for name, weight in saved.policy.state_dict().items():
        assert th.equal(first.state[name], weight), name
    after = evaluations(folder)
    assert after[0] == list(range(100, run.n_timesteps + 1, 100))
    assert (after[1][: len(before[0])] == before[1]).all()
    assert sorted(path.name for path in folder.glob("*.csv")) == [
        "0.1.monitor.csv",
        "0.monitor.csv",
    ]
    episodes = load_results(folder)
    assert len(episodes) > len(monitored)
    assert (episodes["r"][: len(monitored)].values == monitored["r"].values).all()
    assert RunFolder(folder).record()["status"] == "finished"
    assert not (folder / "resume").exists()
    assert done.model.num_timesteps >= run.n_timesteps
    assert done.model._total_timesteps == run.n_timesteps
    if cls is PPO:
        assert done.model.get_vec_normalize_env().obs_rms.count > 500
    with pytest.raises(ConfigError, match="is finished"):
        resume(folder)


class Look(BaseCallback):
    """What the model is when training begins."""

    def _on_training_start(self) -> None:
        policy = self.model.policy
        self.steps = self.model.num_timesteps
        (monitor, *_) = self.training_env.get_attr("results_writer")
        best = Path(monitor.file_handler.name).with_name("best_model.zip")
        self.best = best.read_bytes() if best.exists() else None
        self.clocks = [network.clock for network in policy.sparse.networks]
        self.state = {name: value.clone() for name, value in policy.state_dict().items()}

    def _on_step(self) -> bool:
        return True


def test_a_second_interrupt_stops_at_once_and_falls_back_to_the_last_checkpoint(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        train(DQN_RUN, tmp_path, [Stop(250, times=2)])
    folder = tmp_path / "dqn" / "CartPole-v1_1"
    assert RunFolder(folder).record()["status"] == "running"
    (folder / "resume" / "unfinished").mkdir()  # half written, and none
    assert RunFolder(folder).last_checkpoint().name == "200"
    best = (RunFolder(folder).last_checkpoint() / "best_model.zip").read_bytes()
    (folder / "best_model.zip").write_bytes(b"half a file of a later evaluation")
    look = Look()
    outcome = resume(folder, [look])
    assert outcome.finished
    assert look.best == best
    assert evaluations(folder)[0] == [100, 200, 300, 400, 500]
    with (folder / "0.1.monitor.csv").open() as file:
        lengths = [int(line.split(",")[1]) for line in list(file)[2:]]
    assert 150 < sum(lengths) <= 200  # what came after the checkpoint is forgotten


def test_a_stop_in_the_last_rollout_leaves_the_last_evaluation_for_later(tmp_path):
    stopped = train(DQN_RUN, tmp_path, [Stop(500)])
    assert not stopped.finished
    assert RunFolder(stopped.folder).record()["status"] == "evaluating"
    assert stopped.model.num_timesteps == 500
    monitored = load_results(stopped.folder)
    assert resume(stopped.folder).finished
    assert evaluations(stopped.folder)[0] == [100, 200, 300, 400, 500]
    assert len(load_results(stopped.folder)) == len(monitored)


def test_two_processes_cannot_train_one_run(tmp_path):
    stopped = train(DQN_RUN, tmp_path, [Stop(150)])

    class Intrude(BaseCallback):
        def _on_training_start(self) -> None:
            with pytest.raises(ConfigError, match="another process is at work in"):
                resume(stopped.folder)

        def _on_step(self) -> bool:
            return True

    assert resume(stopped.folder, [Intrude()]).finished


class Break(BaseCallback):
    """An environment or a disk that fails."""

    def __init__(self, at: int) -> None:
        super().__init__()
        self.at = at

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            raise OSError("no space left")
        return True


class Poison(BaseCallback):
    """Puts a value into a weight at some step, as a loss that explodes does."""

    def __init__(self, at: int, value: float = float("nan")) -> None:
        super().__init__()
        self.at, self.value = at, value

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            with th.no_grad():
                parameter = next(self.model.policy.parameters())
                parameter.view(-1)[0] = self.value
        return True


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_run_that_diverges_says_at_which_step_and_keeps_its_last_policy_of_numbers(
    value, tmp_path
):
    with pytest.raises(Diverged, match="at step 300 there is NaN or infinity in .*learning_rate"):
        train(DQN_RUN, tmp_path, [Poison(225, value)])
    folder = tmp_path / "dqn" / "CartPole-v1_1"
    record = RunFolder(folder).record()
    assert (record["status"], record["num_timesteps"]) == ("diverged", 300)
    assert record["last_policy"] == 200
    assert "at step 300" in record["error"]
    assert "the last policy is that of step 200" in record["error"]
    assert "results" not in record
    assert evaluations(folder)[0] == [100, 200]
    for name in ("CartPole-v1.zip", "best_model.zip"):
        model = DQN.load(folder / name)
        assert model.num_timesteps <= 200
        assert all(bool(th.isfinite(p).all()) for p in model.policy.parameters())
    assert not (folder / "resume").exists()
    assert enjoy(folder, episodes=1).episodes == 1
    with pytest.raises(ConfigError, match=r"has ended: training diverged: at step 300"):
        resume(folder)


def test_a_checkpoint_is_never_of_networks_that_diverged(tmp_path):
    class After(Poison):  # the evaluation at step 200, before the checkpoint
        def _on_rollout_end(self) -> None:
            if self.num_timesteps == 200:
                self.at = 200
                self._on_step()

    with pytest.raises(Diverged, match="at step 200"):
        train(DQN_RUN, tmp_path, [After(-1)])
    folder = tmp_path / "dqn" / "CartPole-v1_1"
    assert RunFolder(folder).record()["last_policy"] == 100
    assert evaluations(folder)[0] == [100, 200]


def test_networks_that_diverge_after_the_last_evaluation_are_no_finished_run(tmp_path):
    run = replace(DQN_RUN, n_timesteps=525)
    with pytest.raises(Diverged, match="at step 525"):
        train(run, tmp_path, [Poison(510)])
    assert RunFolder(tmp_path / "dqn" / "CartPole-v1_1").record()["last_policy"] == 500


@pytest.mark.parametrize("n_steps", [64, 128])
def test_what_sb3_raises_of_networks_that_diverged_is_said_to_be_that(n_steps, tmp_path):
    large = {"learning_rate": 1e30, "n_steps": n_steps}
    run = replace(PPO_RUN, hyperparams={**PPO_RUN.hyperparams, **large})
    with pytest.raises(Diverged, match="training diverged: at step") as caught:
        train(run, tmp_path)
    assert "no policy was saved before" in str(caught.value)
    record = RunFolder(tmp_path / "ppo" / "Pendulum-v1_1").record()
    assert (record["status"], record["last_policy"]) == ("diverged", None)


def test_an_error_of_a_callback_is_none_of_the_networks(tmp_path):
    class Refuse(BaseCallback):
        def _on_step(self) -> bool:
            raise ValueError("Expected parameter scale")

    with pytest.raises(ValueError, match="Expected parameter scale") as caught:
        train(PPO_RUN, tmp_path, [Refuse()])
    assert not isinstance(caught.value, Diverged)


class Broken(PendulumEnv):
    """Observes NaN after a while."""

    def step(self, action):
        observation, *rest = super().step(action)
        self.steps = getattr(self, "steps", 0) + 1
        return observation * (np.nan if self.steps == 70 else 1), *rest


def test_an_observation_that_is_nan_is_an_error_of_the_environment(tmp_path):
    gym.register("Broken-v0", Broken, max_episode_steps=200)
    hyperparams = {**PPO_RUN.hyperparams, "normalize": False}
    run = replace(PPO_RUN, env_id="Broken-v0", hyperparams=hyperparams)
    with pytest.raises(ValueError, match="Expected parameter loc") as caught:
        train(run, tmp_path)
    assert not isinstance(caught.value, Diverged)
    assert RunFolder(tmp_path / "ppo" / "Broken-v0_1").record()["status"] == "failed"


def test_actions_without_a_distribution_are_those_of_networks_that_diverged():
    model = PPO("MlpPolicy", "Pendulum-v1")
    with th.no_grad():
        model.policy.log_std.fill_(-1e30)  # finite, but its exponential is 0
    without = pytest.raises(Diverged, match="at step 0 the policy's outputs define no distribution")
    with without, diverging(model):
        model.predict(np.zeros(3, np.float32))


def test_an_evaluation_without_a_finite_return_ends_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "stable_baselines3.common.callbacks.evaluate_policy",
        lambda *args, **kwargs: ([float("nan")], [1]),
    )
    with pytest.raises(Diverged, match="the evaluation at step 100 has the return nan"):
        train(DQN_RUN, tmp_path)
    assert RunFolder(tmp_path / "dqn" / "CartPole-v1_1").record()["status"] == "diverged"


def test_a_run_that_failed_says_so_and_can_go_on(tmp_path):
    with pytest.raises(OSError, match="no space left"):
        train(DQN_RUN, tmp_path, [Break(250)])
    folder = tmp_path / "dqn" / "CartPole-v1_1"
    record = RunFolder(folder).record()
    assert (record["status"], record["error"]) == ("failed", "OSError: no space left")
    assert resume(folder).finished
    assert RunFolder(folder).record()["error"] is None


def full(*args, **kwargs):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_says_what_is_kept_and_how_to_go_on(tmp_path, monkeypatch):
    log_folder = tmp_path / "my logs"
    save = BufferSaver.save
    monkeypatch.setattr(BufferSaver, "save", lambda *a: (full if a[2] > 200 else save)(*a))
    with pytest.raises(Unwritable, match="No space left on device. The run stopped at") as caught:
        train(DQN_RUN, log_folder)
    monkeypatch.undo()
    folder = log_folder / "dqn" / "CartPole-v1_1"
    assert f"{folder} cannot be written" in str(caught.value)
    assert f"from step 200: sb3-sparse train --resume '{folder}'" in str(caught.value)
    record = RunFolder(folder).record()
    assert (record["status"], "No space left" in record["error"]) == ("failed", True)
    assert [path.name for path in (folder / "resume").iterdir()] == ["200"]
    assert resume(folder).finished


def test_a_record_that_cannot_be_written_stays_as_it_is(tmp_path, monkeypatch):
    RunFolder(tmp_path).write(status="running", number=1)
    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        RunFolder(tmp_path).write(status="finished")
    monkeypatch.undo()
    assert RunFolder(tmp_path).record() == {"format": 1, "status": "running", "number": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["sparsity.json"]


def test_a_full_disk_under_everything_leaves_the_status_of_a_run_that_was_killed(
    tmp_path, monkeypatch
):
    class Fill(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 225:
                monkeypatch.setattr(Path, "replace", full)
                monkeypatch.setattr(BufferSaver, "save", full)
            return True

    with pytest.raises(Unwritable, match="resume it from step 200"):
        train(DQN_RUN, tmp_path, [Fill()])
    monkeypatch.undo()
    folder = tmp_path / "dqn" / "CartPole-v1_1"
    assert RunFolder(folder).record()["status"] == "running"
    DQN.load(folder / "best_model.zip")
    assert evaluations(folder)[0] == [100, 200]  # as before the disk was full
    assert resume(folder).finished


def test_a_folder_that_cannot_be_written_to_is_named_with_the_option(tmp_path):
    (tmp_path / "logs").write_text("no folder")
    with pytest.raises(Unwritable, match="cannot be written: Not a directory.*--log-folder"):
        train(DQN_RUN, tmp_path / "logs")


def test_a_run_tells_of_each_evaluation_and_each_episode_at_its_end(finished, seen):
    assert seen.folders == [(finished.folder, None)]
    steps, results = evaluations(finished.folder)
    assert [one[0] for one in seen.evaluations] == steps
    assert [one[1] for one in seen.evaluations] == results.mean(axis=1).tolist()
    assert [one[2] for one in seen.evaluations] == results.std(axis=1).tolist()
    best = np.maximum.accumulate(results.mean(axis=1))
    assert [one[3] for one in seen.evaluations] == best.tolist()
    for what in (
        "Evaluating the last policy",
        "Evaluating the best policy",
    ):  # as many as --eval-episodes says
        told = [one[1:] for one in seen.episodes if one[0] == what]
        assert told == [(0, 2), (1, 2), (2, 2)]
    assert [result.episodes for result in finished.results] == [2, 2]


def test_while_a_run_is_pruned_there_is_no_best(tmp_path):
    seen = Seen()
    run = replace(DQN_RUN, method="prune")
    train(run, tmp_path, watch=seen)
    assert [best is None for *_, best in seen.evaluations] == [True, True, True, True, False]


@pytest.fixture(scope="module")
def stopped_once(tmp_path_factory):
    """Folder of a run that was stopped after 250 steps."""
    return train(DQN_RUN, tmp_path_factory.mktemp("logs"), [Stop(250)]).folder


@pytest.fixture
def stopped(stopped_once, tmp_path):
    """A copy of it."""
    return shutil.copytree(stopped_once, tmp_path / "dqn" / stopped_once.name)


def test_a_checkpoint_that_cannot_be_read_is_named(stopped):
    (RunFolder(stopped).last_checkpoint() / "CartPole-v1.zip").write_bytes(b"")
    with pytest.raises(CorruptStateError, match=r"resume/250/CartPole-v1.zip is damaged"):
        resume(stopped)


def test_a_run_whose_buffer_is_not_whole_goes_on_with_none_only_when_told(stopped):
    buffer = RunFolder(stopped).last_checkpoint() / "replay_buffer"
    (buffer / "0.npz").unlink()
    with pytest.raises(ConfigError, match="0.npz is missing. Restore it from a copy, or delete"):
        resume(stopped)
    assert RunFolder(stopped).record()["status"] == "interrupted"
    shutil.rmtree(buffer)
    with pytest.warns(UserWarning, match="continues with an empty one"):
        done = resume(stopped)
    assert done.finished
    assert done.model.replay_buffer.size() == 250  # of 500
    assert RunFolder(stopped).record()["without_buffer_from"] == 250


def test_an_environment_that_breaks_loses_nothing_of_a_trained_run(tmp_path, monkeypatch):
    def die(*args, **kwargs):
        raise RuntimeError("no simulator")

    monkeypatch.setattr("sb3_sparse.zoo.training.final_results", die)
    with pytest.raises(RuntimeError, match="no simulator"):
        train(DQN_RUN, tmp_path)
    folder = tmp_path / "dqn" / "CartPole-v1_1"
    for _ in range(2):
        assert RunFolder(folder).record()["status"] == "failed"
        with pytest.raises(RuntimeError, match="no simulator"):
            resume(folder)
    monkeypatch.undo()
    look = Look()
    assert resume(folder, [look]).finished
    assert not hasattr(look, "steps")  # never trained again


def test_a_run_that_cannot_begin_leaves_nothing(tmp_path):
    wrong = replace(DQN_RUN, hyperparams={**DQN_RUN.hyperparams, "optimizer_kwargs": {"eps": -1}})
    with pytest.raises(ConfigError, match="do not work: ValueError: Invalid epsilon"):
        train(wrong, tmp_path)
    assert not list((tmp_path / "dqn").iterdir())


@pytest.mark.skipif(th.cuda.is_available(), reason="needs a machine without CUDA")
def test_a_device_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="no device 'cuda' here"):
        train(replace(DQN_RUN, device="cuda"), tmp_path)
    for device in ("gpu", "3", "cuda:77"):
        with pytest.raises(ConfigError, match=f"no device '{device}' here; give --device auto or"):
            train(replace(DQN_RUN, device=device), tmp_path)
    assert train(replace(DQN_RUN, n_timesteps=100), tmp_path).model.device.type == "cpu"
    assert RunFolder(tmp_path / "dqn" / "CartPole-v1_1").record()["device"] == "cpu"


def test_a_run_that_died_before_its_first_evaluation_starts_again(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        train(DQN_RUN, tmp_path, [Stop(60, times=2)])
    folder = tmp_path / "dqn" / "CartPole-v1_1"
    assert RunFolder(folder).last_checkpoint() is None
    assert resume(folder).finished
    assert evaluations(folder)[0] == [100, 200, 300, 400, 500]


def test_a_run_that_died_in_its_last_evaluation_only_does_that_again(tmp_path, monkeypatch):
    def die(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("sb3_sparse.zoo.training.final_results", die)
    with pytest.raises(KeyboardInterrupt):
        train(DQN_RUN, tmp_path)
    monkeypatch.undo()
    folder = tmp_path / "dqn" / "CartPole-v1_1"
    steps = Look()
    assert resume(folder, [steps]).finished
    assert not hasattr(steps, "steps")  # never trained
    assert evaluations(folder)[0] == [100, 200, 300, 400, 500]


def test_a_resume_needs_nothing_but_the_run(tmp_path, monkeypatch):
    path = tmp_path / "mine.yml"
    path.write_text(DQN_RUN.config.read_text())
    run = replace(DQN_RUN, conf_file=str(path))
    stopped = train(run, tmp_path, [Stop(150)])
    path.unlink()
    monkeypatch.setattr("sb3_sparse.zoo.spec.evaluation_of", None)
    assert resume(stopped.folder).finished
    assert evaluations(stopped.folder)[0] == [100, 200, 300, 400, 500]


def test_masks_move_after_a_resume_as_the_schedule_says(tmp_path):
    run = replace(DQN_RUN, hyperparams={**DQN_RUN.hyperparams, "net_arch": [64, 64]})
    stopped = train(run, tmp_path, [Stop(250)])
    done = resume(stopped.folder)
    # every 20 gradient steps, which begin after 50 steps of collecting; the last one or two have
    # a drop fraction too small for a single connection
    counts = [one.policy.sparse.networks[0].mask_updates for one in (stopped.model, done.model)]
    assert counts[0] == (250 - 50) // 20
    assert (0.8 * 500 - 50) // 20 - 2 <= counts[1] <= (0.8 * 500 - 50) // 20


def test_a_dense_run_of_equal_parameters_says_what_it_reached(tmp_path):
    run, seen = RunSpec(method="dense", match_params=0.9, n_timesteps=100, **QUICK), Seen()
    outcome = train(run, tmp_path, watch=seen)
    record = RunFolder(outcome.folder).record()
    match = record["match"]
    assert match["target"] == (2048 + 23451 + 1024) + 512 + 512 + 2  # the vector of 4-512-512-2
    width, _ = outcome.model.policy.net_arch
    assert match["achieved"] == record["total"]["parameters"]
    assert match["achieved"] == 5 * width + (width + 1) * width + (width + 1) * 2
    assert abs(match["achieved"] - match["target"]) < 170  # one unit more or less is twice that
    assert record["total"]["sparsity"] == 0
    ((_, told),) = seen.folders
    assert (told.target, told.achieved) == (match["target"], match["achieved"])


def test_a_kill_within_an_evaluation_costs_nothing(tmp_path):
    stopped = train(DQN_RUN, tmp_path, [Stop(250)])
    (stopped.folder / "unfinished").mkdir()  # where an evaluation puts its files
    (stopped.folder / "unfinished" / "best_model.zip").write_bytes(b"the first part")
    assert resume(stopped.folder).finished
    assert not (stopped.folder / "unfinished").exists()
    DQN.load(stopped.folder / "best_model.zip")


def test_tensorboard_goes_on_in_the_same_folder(tmp_path):
    log = str(tmp_path / "tb")
    stopped = train(DQN_RUN, tmp_path / "logs", [Stop(250)], tensorboard_log=log)
    resume(stopped.folder)
    folders = {path.parent for path in (tmp_path / "tb").rglob("*tfevents*")}
    assert [folder.name for folder in folders] == ["dqn_CartPole-v1_1_1"]


def test_noise_and_other_wrappers_come_from_the_settings(tmp_path):
    wrapper = [{"sb3_sparse.wrappers.ObservationNoise": {"sigma": 0.1, "std": [1, 1, 1, 1]}}]
    run = RunSpec(n_timesteps=100, hyperparams={"env_wrapper": wrapper, **SMALL}, **QUICK)
    outcome = train(run, tmp_path)
    assert outcome.finished
    assert enjoy(outcome.folder, episodes=2).episodes == 2


def test_a_wrapper_may_end_episodes(tmp_path):
    wrapper = [{"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 20}}]
    run = replace(PPO_RUN, hyperparams={**PPO_RUN.hyperparams, "env_wrapper": wrapper})
    outcome = train(run, tmp_path)
    lengths = np.load(outcome.folder / "evaluations.npz")["ep_lengths"]
    assert lengths.tolist() == 5 * [[20, 20]]
    assert load_results(str(outcome.folder))["l"].tolist() == 25 * [20]
    assert len(outcome.model.ep_info_buffer) == 25
    assert enjoy(outcome.folder, episodes=2).episodes == 2


@pytest.mark.parametrize(
    ("run", "argument"),
    [
        (DQN_RUN, {"replay_buffer_class": "stable_baselines3.common.buffers.NStepReplayBuffer"}),
        (PPO_RUN, {"rollout_buffer_class": "stable_baselines3.common.buffers.RolloutBuffer"}),
    ],
)
def test_a_buffer_may_be_a_dotted_path(run, argument, tmp_path):
    ((name, path),) = argument.items()
    outcome = train(replace(run, hyperparams={**run.hyperparams, **argument}), tmp_path)
    buffer = getattr(outcome.model, name.removesuffix("_class"))
    assert f"{type(buffer).__module__}.{type(buffer).__name__}" == path
    assert RunFolder(outcome.folder).record()["settings"][name] == path


@pytest.mark.parametrize(
    ("path", "what"),
    [
        ("no.such.Buffer", "cannot be imported"),
        ("stable_baselines3.NoBuffer", "cannot be imported"),
        ("Buffer", "cannot be imported"),
        ("torch.nn.Tanh", "is not a subclass of stable_baselines3.common.buffers.R"),
    ],
)
@pytest.mark.parametrize(
    ("run", "name"), [(DQN_RUN, "replay_buffer_class"), (PPO_RUN, "rollout_buffer_class")]
)
def test_a_buffer_that_is_none_is_refused_before_anything(run, name, path, what, tmp_path):
    run = replace(run, hyperparams={**run.hyperparams, name: path})
    with pytest.raises(ConfigError, match=f"^{name}='{path}' {what}"):
        train(run, tmp_path)
    assert not list(tmp_path.iterdir())


def test_evaluation_has_the_environments_arguments_too(tmp_path):
    run = replace(PPO_RUN, hyperparams={**PPO_RUN.hyperparams, "env_kwargs": {"g": 0.0}})
    made = []

    class Gravity(BaseCallback):
        def _on_step(self) -> bool:
            made.extend(self.training_env.get_attr("g"))
            made.extend(evaluation.eval_env.get_attr("g"))
            return False

        def _on_training_start(self) -> None:
            nonlocal evaluation
            callbacks = self.locals["callback"].callbacks
            (evaluation,) = (one for one in callbacks if hasattr(one, "eval_env"))

    evaluation = None
    train(run, tmp_path, [Gravity()])
    assert set(made) == {0.0}


def test_enjoy_scores_last_and_best_with_the_runs_normalization(tmp_path):
    outcome = train(PPO_RUN, tmp_path)
    for best, name in ((False, "Pendulum-v1.zip"), (True, "best_model.zip")):
        score = enjoy(outcome.folder, episodes=3, best=best)
        assert score.model == outcome.folder / name
        assert -2000 < score.mean_return < 0
        assert score.std_return > 0
    (outcome.folder / "Pendulum-v1.zip").unlink()
    with pytest.raises(ConfigError, match=r"has no Pendulum-v1.zip \(its models: best_model.zip\)"):
        enjoy(outcome.folder)


def test_folders_are_numbered_on_and_never_shared(tmp_path):
    (tmp_path / "A-v1_7").mkdir()
    (tmp_path / "A-v1_old").mkdir()
    assert RunFolder.new(tmp_path.parent, tmp_path.name, "A-v1").path.name == "A-v1_8"
    assert RunFolder.new(tmp_path.parent, tmp_path.name, "A-v1").path.name == "A-v1_9"
    assert RunFolder.new(tmp_path.parent, tmp_path.name, "B-v1").path.name == "B-v1_1"


def test_the_algorithms_are_those_with_a_sparse_policy():
    assert set(algorithms()) == {name.lower() for name in ALGORITHMS}


@pytest.mark.filterwarnings("ignore")  # so short that no mask moves
@pytest.mark.parametrize("method", ["dense", "prune", "static", "set", "rigl"])
@pytest.mark.parametrize("algo", sorted(algorithms()))
def test_every_method_and_algorithm_runs_by_its_config(method, algo, tmp_path):
    discrete = algo in ("dqn", "qrdqn")
    run = RunSpec(
        algo=algo,
        env_id="CartPole-v1" if discrete else "Pendulum-v1",
        method=method,
        n_timesteps=16,
        eval_freq=16,
        eval_episodes=1,
        hyperparams={"net_arch": [8, 8], "env_kwargs": {"max_episode_steps": 20}}
        | ({"n_steps": 8} if algo in ("ppo", "a2c", "trpo") else {"learning_starts": 8}),
    )
    outcome = train(run, tmp_path)
    assert outcome.finished
    policy = outcome.model.policy
    kwargs = run.settings()["policy_kwargs"]
    assert policy.sparsity_config.sparsity == kwargs["sparsity"]
    assert policy.sparse.weight_decay == kwargs["weight_decay"]


def test_an_atari_run_stacks_frames_resumes_and_is_filmed(tmp_path, monkeypatch):
    small = {"channels": [2, 2, 2], "features_dim": 8}
    run = RunSpec(
        env_id="PongNoFrameskip-v4",
        conf_file="dqn_impala",
        n_timesteps=60,
        eval_freq=30,
        eval_episodes=1,
        hyperparams={
            "features_extractor_kwargs": small,
            "learning_starts": 8,
            "buffer_size": 100,
            "env_kwargs": {"max_num_frames_per_episode": 400},
        },
    )
    stopped = train(run, tmp_path, [Stop(40)])
    assert stopped.folder == tmp_path / "dqn" / "PongNoFrameskip-v4_1"
    outcome = resume(stopped.folder)
    assert outcome.model.observation_space.shape == (4, 84, 84)
    assert evaluations(outcome.folder)[0] == [30, 60]
    assert RunFolder(outcome.folder).record()["layers"][0]["shape"] == [2, 4, 3, 3]
    score = enjoy(outcome.folder, episodes=1, video=True)
    assert -21 <= score.mean_return <= 21
    (video,) = score.videos
    assert video.suffix == ".mp4"
    assert video.stat().st_size > 1000
