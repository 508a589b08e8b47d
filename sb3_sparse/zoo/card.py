"""The model card of a run for the Hugging Face Hub: a README with metadata, beside the run."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from sb3_sparse.errors import ConfigError, command
from sb3_sparse.files import written_whole
from sb3_sparse.pages.plot import save_png
from sb3_sparse.policies.report import SparsityReport
from sb3_sparse.zoo.archive import Archived
from sb3_sparse.zoo.curve import CURVE, curve, what_was_trained
from sb3_sparse.zoo.folder import RunFolder, env_name
from sb3_sparse.zoo.inspection import inspect_model
from sb3_sparse.zoo.record import Record, Status
from sb3_sparse.zoo.results import score_of
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.versions import NAME

README = "README.md"
TASK = "reinforcement-learning"
LIBRARY = "stable-baselines3"
NOBODY = "YOUR-NAME"
"""Stands for the account in the id of a repository until one is given."""
PRIVATE = "*/command.txt"
"""rl-zoo's file of the command as it was typed, with paths of the machine."""
LAST, BEST = "Last policy", "Best policy"
LAYOUT = {"default_flow_style": False, "sort_keys": False, "allow_unicode": True, "width": 4096}


@dataclass(frozen=True)
class Card:
    """A model card. :meth:`of` makes one, and :meth:`write` writes it.

    Its metadata have the form of huggingface_sb3, so the Hub lists the model under its environment,
    with its return.

    Example::

        from sb3_sparse.zoo import Card, RunSpec, train

        outcome = train(RunSpec(n_timesteps=200, eval_freq=100, eval_episodes=1))
        card = Card.of(outcome.folder, best=True, repo_id="me/dqn-CartPole-v1")
        print(card.write())  # .../README.md
        print(card.push)  # hf upload me/dqn-CartPole-v1 ...

    :param folder: the run's folder
    :param run: the run, with its evaluations
    :param spec: what it was to train
    :param best: whether the metadata and the sparsity are those of the best policy
    :param report: layers of that policy
    :param repo_id: id of the repository on the Hub
    """

    folder: RunFolder
    run: Archived
    spec: RunSpec
    best: bool
    report: SparsityReport
    repo_id: str

    @classmethod
    def of(cls, folder: Path, *, best: bool = False, repo_id: str | None = None) -> Card:
        """Make the card of a run.

        :param folder: the run's folder
        :param best: take its best policy instead of its last
        :param repo_id: id of the repository on the Hub, ``"name/model"``; None: a placeholder
        :raises ConfigError: if there is no run, if it is not finished, or if it has no best policy
        :raises CorruptStateError: if a file of the run is damaged
        """
        own = RunFolder(folder)
        record = own.record()
        if record.status is not Status.FINISHED:
            raise ConfigError(
                f"the run in {own} has the status {str(record.status)!r}, and only a finished run "
                f"gets a card; resume an interrupted one with {command('train', '--resume', own)}"
            )
        spec = record.spec
        if repo_id is None:
            repo_id = f"{NOBODY}/{spec.algo}-{env_name(spec.env_id)}"
        account, _, name = repo_id.partition("/")
        if not account or not name or set(name) & set("/ "):
            raise ConfigError(
                f"repo_id must be name/model, e.g. me/{spec.algo}-{env_name(spec.env_id)}, got "
                f"{repo_id!r}"
            )
        with record.reading():
            report = inspect_model(folder, best).report
            return cls(own, Archived.of_folder(own, ""), spec, best, report, repo_id)

    @property
    def metadata(self) -> dict[str, Any]:
        """What the Hub reads: the library, tags, and the mean reward of the policy."""
        with self._record.reading():
            results = {one["what"]: one for one in self._record["results"]}
            result = results[BEST if self.best else LAST]
            reward = f"{result['mean_return']:.2f} +/- {result['std_return']:.2f}"
        sparse = ["sparse-training"] if self.report.sparsity() else []
        env_id = self.spec.env_id
        measured = {
            "task": {"type": TASK, "name": TASK},
            "dataset": {"name": env_id, "type": env_id},
            "metrics": [
                {"type": "mean_reward", "value": reward, "name": "mean_reward", "verified": False}
            ],
        }
        return {
            "library_name": LIBRARY,
            "tags": [env_id, "deep-reinforcement-learning", TASK, LIBRARY, *sparse],
            "model-index": [{"name": self._algorithm, "results": [measured]}],
        }

    @property
    def push(self) -> str:
        """The command of huggingface_hub that uploads the run's folder with its card."""
        words = ["hf", "upload", self.repo_id, str(self.folder), "--exclude", PRIVATE]
        return shlex.join(words)

    def write(self) -> Path:
        """Write ``README.md`` and ``curve.png`` into the run's folder.

        :return: the card's file
        """
        drawn = curve(self._title, self.run.timesteps, self.run.returns)
        save_png(self.folder.path / CURVE, drawn.figure)
        path = self.folder.path / README
        with written_whole(path) as new:
            new.write_text(str(self), encoding="utf-8")
        return path

    def __str__(self) -> str:
        head = yaml.safe_dump(self.metadata, **LAYOUT)
        with self._record.reading():
            parts = [self._outcome(), self._sparsity(), self._loading(), self._training()]
        return f"---\n{head}---\n\n# {self._title}\n\n" + "\n".join(
            line for part in parts for line in part
        )

    def _outcome(self) -> Iterator[str]:
        yield (
            f"An agent trained by [Stable-Baselines3](https://github.com/DLR-RM/{LIBRARY}) with "
            f"{NAME}, a plugin for sparse training.\n"
        )
        yield "## Results\n"
        yield "| policy | mean return | standard deviation | episodes | file |"
        yield "| --- | ---: | ---: | ---: | --- |"
        for one in self._record["results"]:
            numbers = f"{one['mean_return']:.2f} | {one['std_return']:.2f} | {one['episodes']}"
            yield f"| {one['what']} | {numbers} | `{one['path']}` |"
        whose = BEST if self.best else LAST
        yield (
            f"\nNo policy was chosen by these episodes. The metadata have the {whose.lower()}'s "
            "return.\n"
        )
        yield f"![Learning curve]({CURVE})\n"
        returns = self.run.returns
        band = (
            f" The band is one standard deviation over its {returns.shape[1]} episodes."
            if returns.shape[1] > 1
            else ""
        )
        score = score_of([float(one) for one in returns.mean(axis=1)])
        yield (
            f"Mean return of each evaluation during training.{band} Over the last tenth of the "
            f"evaluations, it is {score:.2f}.\n"
        )

    def _sparsity(self) -> Iterator[str]:
        yield f"## Sparsity of the {(BEST if self.best else LAST).lower()}\n"
        report = self.report
        size = sum(layer.size for layer in report.layers)
        yield (
            f"{report.nnz:,} of {size:,} connections are active. `nnz` counts them in each layer, "
            "and FLOPs are those of one forward pass.\n"
        )
        yield f"```text\n{report}\n```\n"

    def _loading(self) -> Iterator[str]:
        local = self.repo_id.rpartition("/")[2]
        best = ["--best"] if self.best else []
        lines = [
            f'pip install "{NAME}[zoo]" huggingface_hub',
            shlex.join(["hf", "download", self.repo_id, "--local-dir", local]),
            command("enjoy", local, *best),
            command("inspect", local, *best),
        ]
        yield "## Load\n"
        if self.spec.gym_packages:
            modules = " and ".join(f"`{name}`" for name in self.spec.gym_packages)
            yield f"Python must find {modules}, which this run imported for its own classes.\n"
        yield from _fenced("sh", lines)
        yield "In Python, with the environment's wrappers and normalisation:\n"
        chosen = ", best=True" if self.best else ""
        yield from _fenced(
            "python",
            [
                "from sb3_sparse.zoo import SavedModel",
                "",
                f'saved = SavedModel.find("{local}"{chosen})',
                "model, envs = saved.load(), saved.evaluation_envs(episodes=1, seed=0)",
                "deterministic = saved.acts_deterministically  # all but Atari games",
                "actions, _ = model.predict(envs.reset(), deterministic=deterministic)",
            ],
        )
        file = self.folder.model(self.spec.env_id, self.best).name
        yield "The model alone:\n"
        yield from _fenced(
            "python", [*self._imports(), "", f'model = {self._algorithm}.load("{local}/{file}")']
        )

    def _imports(self) -> Sequence[str]:
        home = self.spec.algorithm.__module__
        package = home.partition(".")[0]
        if package == "sb3_sparse":
            return [f"from sb3_sparse import {self._algorithm}"]
        known = "import sb3_sparse  # registers the sparse policies"
        where = package if package == "sb3_contrib" else home
        return [known, f"from {where} import {self._algorithm}"]

    def _training(self) -> Iterator[str]:
        spec, evaluation = self.spec, self._record.evaluation
        words: list[object] = ["train", "--algo", spec.algo, "--env", spec.env_id]
        words += ["--conf-file", "settings.yml", "--seed", spec.seed]
        words += ["--eval-freq", evaluation["eval_freq"]]
        words += ["--eval-episodes", evaluation["eval_episodes"]]
        words += [word for package in spec.gym_packages for word in ("--gym-packages", package)]
        settings = {spec.env_id: dict(self._record.settings)}
        yield "## Train\n"
        yield "With these settings in a file `settings.yml`:\n"
        yield from _fenced("yaml", yaml.safe_dump(settings, **LAYOUT).splitlines())
        yield from _fenced("sh", [command(*words)])
        known: Mapping[str, str] = self._record.get("versions", {})
        yield ", ".join(f"{name} {version}" for name, version in known.items()) + ".\n"

    @property
    def _record(self) -> Record:
        return self.run.record

    @property
    def _algorithm(self) -> str:
        return self.spec.algorithm.__name__

    @property
    def _title(self) -> str:
        return what_was_trained(self.spec, str(self._record["method"]), self.report.sparsity())


def _fenced(language: str, lines: Sequence[str]) -> Iterator[str]:
    yield "\n".join([f"```{language}", *lines, "```", ""])
