"""Trains and resumes runs, from names to a folder with model, evaluations and record."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sparse.errors import ConfigError, CorruptStateError, command
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.zoo.checkpoint import Checkpoints, StopTraining, restored_monitors
from sb3_sparse.zoo.clock import Clock, Seconds, seconds_in
from sb3_sparse.zoo.computing import (
    computing_at,
    counts_of,
    denormals_as_zero,
    use_few_threads,
)
from sb3_sparse.zoo.disk import writing
from sb3_sparse.zoo.divergence import check_networks
from sb3_sparse.zoo.ending import diverging, recorded
from sb3_sparse.zoo.evaluation import Evaluated, Evaluation
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.manager import RunManager, spaces_of
from sb3_sparse.zoo.prepare import prepare, settings_fail, setup_errors
from sb3_sparse.zoo.record import CURE, Status
from sb3_sparse.zoo.results import Outcome, final_results
from sb3_sparse.zoo.resuming import check_start
from sb3_sparse.zoo.saved import EVALUATION_ENVS
from sb3_sparse.zoo.settings import Settings
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.validation import check_settings
from sb3_sparse.zoo.versions import continued, versions
from sb3_sparse.zoo.watch import Watch


def train(
    run: RunSpec,
    log_folder: Path = Path("logs"),
    callbacks: Sequence[BaseCallback] = (),
    tensorboard_log: str = "",
    after_evaluation: BaseCallback | None = None,
    folder: Path | None = None,
    watch: Watch | None = None,
) -> Outcome:
    """Train a run in ``log_folder/<algo>/<env>_<number>``.

    SIGINT and SIGTERM stop it at the end of the current rollout; :func:`resume` continues it.

    Example::

        from pathlib import Path
        from sb3_sparse.zoo import RunSpec, train

        run = RunSpec(algo="dqn", env_id="CartPole-v1", n_timesteps=1000, eval_episodes=1)
        outcome = train(run, Path("logs"))
        print(outcome.folder, outcome.sparsity, outcome.results[0].mean_return)

    :param callbacks: further callbacks
    :param tensorboard_log: folder for TensorBoard; empty: none
    :param after_evaluation: called after each evaluation; the evaluation is its ``parent``
    :param folder: the run's own folder, ``.../<algo>/<name>``, instead of the next free number in
        ``log_folder``; nothing else may be in it
    :param watch: called as a callback, and notified of what happens outside training
    :raises ConfigError: if the environment cannot be made or the algorithm cannot act in it
    :raises Diverged: if a network comes to hold NaN; the record gets the status ``"diverged"``
    """
    if tensorboard_log and importlib.util.find_spec("tensorboard") is None:
        raise ConfigError("--tensorboard-log needs TensorBoard: pip install tensorboard")
    if tensorboard_log:
        tensorboard_log = str(Path(tensorboard_log).absolute())  # may resume elsewhere
    prepared = prepare(run, log_folder)
    use_few_threads(prepared.observation_space)
    with writing(folder or log_folder, "make it writable, or give another with --log-folder"):
        if folder is None:
            own = RunFolder.new(log_folder, run.algo, run.env_id)
        else:
            own = RunFolder(folder)
            folder.mkdir(parents=True, exist_ok=True)
    with own.locked():
        if own.has_record:
            raise ConfigError(
                f"there is already a run in {own}; resume it with "
                f"{command('train', '--resume', own)}, or give another folder"
            )
        own.write(status=Status.RUNNING, **prepared.record(run), tensorboard_log=tensorboard_log)
        watch = watch or Watch()
        watch.begins(own.path, prepared.match)
        model = None
        try:
            with setup_errors(settings_fail(run), run.env_id):
                manager = RunManager(
                    run,
                    prepared.settings,
                    own,
                    prepared.evaluation,
                    tensorboard_log=tensorboard_log,
                )
                model = manager.setup()
            return _Session(run, manager, model, callbacks, watch, after_evaluation).outcome()
        except Exception:
            if model is None or model.num_timesteps == 0:
                shutil.rmtree(own.path, ignore_errors=True)  # nothing was trained
            raise


def resume(
    folder: Path, callbacks: Sequence[BaseCallback] = (), watch: Watch | None = None
) -> Outcome:
    """Continue an interrupted run from its last checkpoint, or from the start if it has none.

    :param folder: the run's folder
    :param callbacks: further callbacks
    :param watch: called as a callback, and notified of what happens outside training
    :raises ConfigError: if there is no run, if it is finished or diverged, or if another process
        is training it
    :raises Diverged: if it diverges
    """
    own = RunFolder(folder)
    own.record()
    with own.locked():
        record = own.record()
        if record.status is Status.FINISHED:
            own.clear_checkpoints()
            raise ConfigError(
                f"the run in {own} is finished; evaluate it with {command('enjoy', own)}, or "
                "train anew, without --resume, for more steps with -n"
            )
        if record.status is Status.DIVERGED:
            raise ConfigError(f"the run in {own} has ended: {record['error']}")
        with record.reading():
            run, evaluation = record.spec, record.evaluation
            settings = Settings(record.settings)  # imports dotted paths, as the record does not
            check_settings(settings, run.algorithm)
            if "n_timesteps" not in settings:
                raise CorruptStateError(
                    f"{record.source} is damaged: its settings lack n_timesteps; {CURE}"
                )
            tensorboard_log = str(record["tensorboard_log"])
            before = {name: str(one) for name, one in record.get("versions", {}).items()}
        start = own.start()
        place = start.folder or "its start"
        failure = f"nothing was changed: the run in {own} cannot resume from {place}"
        with setup_errors(failure, run.env_id), ExitStack() as stack:
            observation_space, _ = spaces_of(run, settings, own, evaluation)
            use_few_threads(observation_space)
            if start.folder is not None:
                check_start(start.folder, run)
            if not start.trained:
                if start.folder is not None:
                    Evaluated.read(start.folder)  # read everything before replacing anything
                stack.enter_context(restored_monitors(own.path, start.folder))
            manager = RunManager(run, settings, own, evaluation, start, tensorboard_log)
            model = manager.setup()
        if not start.trained:
            own.write(versions=versions() if start.folder is None else continued(before))
        watch = watch or Watch()
        watch.begins(own.path, None)
        return _Session(run, manager, model, callbacks, watch).outcome()


class _Session:
    """The work of one process on a run: training from a start point, and the final evaluation."""

    def __init__(
        self,
        run: RunSpec,
        manager: RunManager,
        model: BaseAlgorithm,
        callbacks: Sequence[BaseCallback],
        watch: Watch,
        after_evaluation: BaseCallback | None = None,
    ) -> None:
        self.run = run
        self.manager = manager
        self.model = model
        self.folder = manager.folder
        self.watch = watch
        self.callbacks = callbacks
        self.after_evaluation = after_evaluation
        self.stop_wanted = False
        anew = manager.start.folder is None
        self.clock = Clock(Seconds() if anew else seconds_in(self.folder.record()))
        policy = unwrapped(model.policy)
        assert isinstance(policy, BaseSparsePolicy)
        self.policy = policy

    def outcome(self) -> Outcome:
        """Train and evaluate the run, unless a signal stops it."""
        episodes = self.manager.evaluation["eval_episodes"]
        with recorded(self.folder, self.run.env_id, self.model):
            envs = self.manager.evaluation_envs(
                min(EVALUATION_ENVS, episodes), self.run.seed + 20_000
            )
            try:
                evaluation = Evaluation(
                    envs,
                    self.folder.path,
                    self.manager.evaluation["eval_freq"],
                    episodes,
                    self.manager.deterministic_eval,
                    self.manager.keep_normalization(),
                    self.watch,
                    self.clock,
                    self.after_evaluation,
                )
                status = self._train(evaluation)
                path = self.manager.save(self.model)
                self.folder.write(
                    status=status,
                    trained=status is Status.EVALUATING,
                    num_timesteps=self.model.num_timesteps,
                    **self.clock.entry(),
                    **counts_of(self.policy),
                )
                if self.stop_wanted:
                    return Outcome(self.folder.path, self.model, ())
                results = final_results(
                    self.run,
                    self.model,
                    path,
                    envs,
                    self.manager.deterministic_eval,
                    episodes,
                    self.watch,
                )
            finally:
                envs.close()
                assert self.model.env is not None
                self.model.env.close()
            told = [{**asdict(one), "path": one.path.name} for one in results]
            self.folder.write(status=Status.FINISHED, results=told)
            self.folder.clear_checkpoints()
        return Outcome(self.folder.path, self.model, results)

    def _train(self, evaluation: Evaluation) -> Status:
        """Train the remaining steps; return the status that the run has then."""
        start, model = self.manager.start, self.model
        if start.folder is None:
            evaluation.forget()
        elif not start.trained:
            evaluation.restore(start.folder)
        left = self.manager.n_timesteps - model.num_timesteps
        self.folder.write(
            status=Status.RUNNING if left > 0 else Status.EVALUATING,
            num_timesteps=model.num_timesteps,
            device=str(model.device),
            error=None,
            **({"computing": computing_at(model, self.folder.record())} if left > 0 else {}),
            **counts_of(self.policy),
        )
        if left <= 0:
            return Status.EVALUATING
        checkpoints = Checkpoints(self.folder, self.run.env_id, evaluation, self.clock)
        during = [*self.manager.callbacks, evaluation, checkpoints, *self.callbacks, self.watch]
        try:
            with (
                checkpoints.on_signals(),
                denormals_as_zero(),
                diverging(model),
                self.clock.running(),
            ):
                model.learn(
                    left,
                    callback=during,
                    reset_num_timesteps=start.folder is None,
                    tb_log_name=f"{self.run.algo}_{self.folder.path.name}",
                )
                check_networks(model)
        except StopTraining:
            return Status.INTERRUPTED
        finally:
            self.stop_wanted = checkpoints.stop_wanted
        return Status.EVALUATING
