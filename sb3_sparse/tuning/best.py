"""The best values of a study, as settings that train as they are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sb3_sparse.errors import ConfigError
from sb3_sparse.files import written_whole
from sb3_sparse.loading.text import read_text
from sb3_sparse.tuning.backend import FrozenTrial, optuna
from sb3_sparse.tuning.objective import VALUES
from sb3_sparse.tuning.spaces import with_values
from sb3_sparse.tuning.study import definition_of, status_of
from sb3_sparse.tuning.yamlfile import as_yaml, merge_entry
from sb3_sparse.zoo.configs import entry_of
from sb3_sparse.zoo.environments import is_atari
from sb3_sparse.zoo.settings import method_of
from sb3_sparse.zoo.spec import RunSpec

BEST = "best.yml"
TUNED = "Tuned by sb3-sparse"


def best_of(study: optuna.Study) -> FrozenTrial:
    """The best trial so far.

    :raises ConfigError: if none was completed
    """
    best = status_of(study).best
    if best is None:
        raise ConfigError(f"no trial of {study.study_name!r} was completed yet; let it go on")
    return best


def best_settings(study: optuna.Study) -> dict[str, Any]:
    """The settings of the tuned run with the best values so far.

    :raises ConfigError: if no trial was completed
    """
    values = best_of(study).user_attrs[VALUES]
    return with_values(definition_of(study).run, values).settings()


def describe_best(study: optuna.Study) -> str:
    """Where the values come from, in a line: study, number of trials, score, date."""
    status, best = status_of(study), best_of(study)
    seeds = definition_of(study).seeds
    mean = f", mean of {seeds} seeds" if seeds > 1 else ""
    finished = [t.datetime_complete for t in status.done if t.datetime_complete is not None]
    return (
        f"{TUNED}: study {study.study_name}, trial {best.number} of {len(status.done)} trials, "
        f"score {best.values[0]:.6g}{mean}, {max(finished).date()}"
    )


def write_best(study: optuna.Study, path: Path) -> Path:
    """Write the best settings as a YAML file in rl-zoo's form.

    :raises ConfigError: if no trial was completed
    """
    env_id = definition_of(study).run.env_id
    text = as_yaml({env_id: best_settings(study)})
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as new:
        new.write_text(f"# {describe_best(study)}\n{text}", encoding="utf-8")
    return path


def check_target(run: RunSpec, path: Path) -> None:
    """Refuse a config that the tuned settings of a run have no place in.

    :raises ConfigError: if there is no such file, it is for another method, or its entry is not
        written in a way that can be changed
    """
    there = method_of(entry_of(path, run.env_id, is_atari(run.env_id)))
    tuned = method_of(run.settings())
    if there != tuned:
        raise ConfigError(
            f"{path} trains {run.env_id} by method {there!r}, but {tuned!r} is tuned; name the "
            "file of that method"
        )
    merge_entry(_read(path), run.env_id, run.settings(), TUNED, TUNED, str(path))


def write_into(study: optuna.Study, path: Path) -> None:
    """Merge the best settings into the tuned environment's entry of an existing YAML file.

    Every other line of the file stays as it is, comments too.

    :param path: in rl-zoo's form, e.g. ``zoo_hparams/rigl/sac.yml``
    :raises ConfigError: if no trial was completed, or the file is for another method or cannot be
        changed without changing what else it says; then it is left as it was
    """
    run, settings = definition_of(study).run, best_settings(study)
    check_target(run, path)
    text = merge_entry(_read(path), run.env_id, settings, describe_best(study), TUNED, str(path))
    with written_whole(path) as new:
        new.write_text(text, newline="", encoding="utf-8")


def _read(path: Path) -> str:
    """A file's text with its own line endings."""
    return read_text(path, "config", "name the config of that method")
