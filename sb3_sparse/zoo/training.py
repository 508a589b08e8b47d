"""One training run, from names to a folder with model, evaluations and ``sparsity.json``."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sparse.errors import ConfigError, command
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.zoo.checkpoint import (
    Checkpoints,
    StopTraining,
    clear_checkpoints,
    last_checkpoint,
    locked,
    restored_monitors,
)
from sb3_sparse.zoo.computing import computing_at
from sb3_sparse.zoo.disk import writing
from sb3_sparse.zoo.divergence import check_networks
from sb3_sparse.zoo.ending import diverging, recorded
from sb3_sparse.zoo.evaluation import Evaluated, Evaluation
from sb3_sparse.zoo.folder import new_run_folder
from sb3_sparse.zoo.manager import RunManager, spaces_of
from sb3_sparse.zoo.plan import check_start, planned
from sb3_sparse.zoo.prepare import doubt, explained, prepare
from sb3_sparse.zoo.record import DIVERGED, NAME, read_record, sparsity_of, write_record
from sb3_sparse.zoo.results import Outcome, final_results
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.speed import denormals_as_zero, use_few_threads
from sb3_sparse.zoo.watch import Watch

EVALUATION_ENVS = 10


def train(
    run: RunSpec,
    log_folder: Path = Path("logs"),
    callbacks: Sequence[BaseCallback] = (),
    tensorboard_log: str = "",
    after_evaluation: BaseCallback | None = None,
    folder: Path | None = None,
    watch: Watch | None = None,
) -> Outcome:
    """Train anew in ``log_folder/<algo>/<env>_<number>``.

    SIGINT and SIGTERM stop it at the end of the current rollout; :func:`resume` goes on.

    :param callbacks: further callbacks
    :param tensorboard_log: where TensorBoard's files go; empty: none
    :param after_evaluation: called after each evaluation; the evaluation is its ``parent``
    :param folder: the run's own folder, ``.../<algo>/<name>``, in place of the next free number in
        ``log_folder``; nothing else may be in it
    :param watch: is called as a callback, and told of what happens
    :raises ConfigError: if the environment cannot be made or the algorithm cannot act in it
    :raises Diverged: if networks come to hold NaN; the record has the status ``"diverged"``
    """
    if tensorboard_log and importlib.util.find_spec("tensorboard") is None:
        raise ConfigError("--tensorboard-log needs TensorBoard: pip install tensorboard")
    if tensorboard_log:
        tensorboard_log = str(Path(tensorboard_log).absolute())  # also after a resume elsewhere
    prepared = prepare(run, log_folder)
    settings, evaluation = prepared.settings, prepared.evaluation
    use_few_threads(prepared.observation_space)
    with writing(folder or log_folder, "make it writable, or give another with --log-folder"):
        if folder is None:
            folder = new_run_folder(log_folder / run.algo, run.env_id.replace("/", "-"))
        else:
            folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        if (folder / NAME).is_file():
            raise ConfigError(
                f"there is a run in {folder} already; go on with it by "
                f"{command('train', '--resume', folder)}, or give another folder"
            )
        write_record(
            folder,
            status="running",
            **prepared.record(run),
            tensorboard_log=tensorboard_log,
        )
        watch = watch or Watch()
        watch.begins(folder, prepared.match)
        model = None
        try:
            with explained(doubt(run), run.env_id):
                experiment = RunManager(run, settings, folder, evaluation, None, tensorboard_log)
                model = experiment.setup()
            with recorded(folder, experiment.env_name, model):
                return _learn(
                    run, experiment, model, folder, None, callbacks, watch, after_evaluation
                )
        except Exception:
            if model is None or model.num_timesteps == 0:
                shutil.rmtree(folder, ignore_errors=True)  # nothing was trained
            raise


def resume(
    folder: Path, callbacks: Sequence[BaseCallback] = (), watch: Watch | None = None
) -> Outcome:
    """Go on with an interrupted run from its last checkpoint, or from the start if it has none.

    :param folder: the run's folder
    :param callbacks: further callbacks
    :param watch: is called as a callback, and told of what happens
    :raises ConfigError: if there is no run, if it is finished or diverged, or if another process
        trains it
    :raises Diverged: if it diverges now
    """
    read_record(folder)
    with locked(folder):
        record = read_record(folder)
        if record["status"] == "finished":
            clear_checkpoints(folder)
            raise ConfigError(
                f"the run in {folder} is finished; look at it with {command('enjoy', folder)}, or "
                "train longer anew with -n"
            )
        if record["status"] == DIVERGED:
            raise ConfigError(f"the run in {folder} has ended: {record['error']}")
        plan = planned(folder, record)
        run, settings, evaluation = plan.run, plan.settings, plan.evaluation
        start = folder if record.get("trained") else last_checkpoint(folder)
        failure = (
            f"nothing was changed: the run in {folder} cannot go on from {start or 'its start'}"
        )
        with explained(failure, run.env_id), ExitStack() as stack:
            observation_space, _ = spaces_of(run, settings, folder, evaluation)
            use_few_threads(observation_space)
            if start is not None:
                check_start(start, run)
            if start != folder:
                if start is not None:
                    Evaluated.read(start)  # all is read before anything is replaced
                stack.enter_context(restored_monitors(folder, start))
            experiment = RunManager(run, settings, folder, evaluation, start, plan.tensorboard_log)
            model = experiment.setup()
        watch = watch or Watch()
        watch.begins(folder, None)
        with recorded(folder, experiment.env_name, model):
            return _learn(run, experiment, model, folder, start, callbacks, watch)


def _learn(
    run: RunSpec,
    experiment: RunManager,
    model: BaseAlgorithm,
    folder: Path,
    start: Path | None,
    callbacks: Sequence[BaseCallback],
    watch: Watch,
    after_evaluation: BaseCallback | None = None,
) -> Outcome:
    policy = unwrapped(model.policy)
    assert isinstance(policy, BaseSparsePolicy)
    schedule = experiment.evaluation
    envs = experiment.evaluation_envs(
        min(EVALUATION_ENVS, schedule["eval_episodes"]), run.seed + 20_000
    )
    evaluation = Evaluation(
        envs,
        folder,
        schedule["eval_freq"],
        schedule["eval_episodes"],
        experiment.deterministic_eval,
        experiment.keep_normalization(),
        watch,
        after_evaluation,
    )
    checkpoints = Checkpoints(folder, experiment.env_name, evaluation)
    during = [*experiment.callbacks, evaluation, checkpoints, *callbacks, watch]
    if start is None:
        evaluation.forget()
    elif start != folder:
        evaluation.restore(start)
    done, planned = model.num_timesteps, experiment.n_timesteps
    status = "running" if done < planned else "evaluating"
    state: dict[str, Any] = {"device": str(model.device), "error": None}
    if status == "running":
        state["computing"] = computing_at(model, read_record(folder), folder)
    write_record(folder, status=status, num_timesteps=done, **state, **sparsity_of(policy))
    try:
        if done < planned:
            status = "evaluating"
            try:
                with checkpoints.on_signals(), denormals_as_zero(), diverging(model):
                    model.learn(
                        planned - done,
                        callback=during,
                        reset_num_timesteps=start is None,
                        tb_log_name=f"{run.algo}_{folder.name}",
                    )
                    check_networks(model)
            except StopTraining:
                status = "interrupted"
        path = experiment.save(model)
        write_record(
            folder,
            status=status,
            trained=status == "evaluating",
            num_timesteps=model.num_timesteps,
            **sparsity_of(policy),
        )
        if checkpoints.stop_wanted:
            return Outcome(folder, model, ())
        results = final_results(
            run,
            model,
            path,
            envs,
            experiment.deterministic_eval,
            schedule["eval_episodes"],
            watch,
        )
    finally:
        envs.close()
        assert model.env is not None
        model.env.close()
    write_record(
        folder, status="finished", results=[{**asdict(r), "path": r.path.name} for r in results]
    )
    clear_checkpoints(folder)
    return Outcome(folder, model, results)
