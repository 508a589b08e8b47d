"""The best values of a search, written as configs that train as they are."""

from __future__ import annotations

from pathlib import Path

from sb3_sparse.errors import ConfigError
from sb3_sparse.files import written_whole
from sb3_sparse.loading.text import read_text
from sb3_sparse.tuning.search import Search
from sb3_sparse.tuning.yamlfile import as_yaml, merge_entry
from sb3_sparse.zoo.configs import entry_of
from sb3_sparse.zoo.environments import is_atari
from sb3_sparse.zoo.settings import Settings
from sb3_sparse.zoo.spec import RunSpec

BEST = "best.yml"
TUNED = "Tuned by sb3-sparse"


def write_best(search: Search, path: Path) -> Path:
    """Write the best settings as a YAML file in rl-zoo's form.

    :raises ConfigError: if no trial was completed
    """
    settings, origin = search.best_entry()
    text = as_yaml({search.definition.run.env_id: settings})
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as new:
        new.write_text(f"# {TUNED}: {origin}\n{text}", encoding="utf-8")
    return path


def check_target(run: RunSpec, path: Path) -> None:
    """Check that the tuned settings of a run can be written into a config.

    :raises ConfigError: if there is no such file, if it is for another method, or if its entry is
        written in a way that cannot be changed
    """
    there = Settings(entry_of(path, run.env_id, is_atari(run.env_id))).method
    tuned = run.settings().method
    if there != tuned:
        raise ConfigError(
            f"{path} trains {run.env_id} by method {there!r}, but {tuned!r} is tuned; name the "
            "file of that method"
        )
    merge_entry(_read(path), run.env_id, run.settings(), TUNED, TUNED, str(path))


def merge_best(search: Search, path: Path) -> None:
    """Merge the best settings into the environment's entry of an existing YAML file.

    Every other line of the file stays as it is, comments included.

    :param path: in rl-zoo's form, e.g. ``zoo_hparams/rigl/sac.yml``
    :raises ConfigError: if no trial was completed, if the file is for another method, or if the
        change would change other entries; the file then stays as it was
    """
    run = search.definition.run
    settings, origin = search.best_entry()
    check_target(run, path)
    comment = f"{TUNED}: {origin}"
    text = merge_entry(_read(path), run.env_id, settings, comment, TUNED, str(path))
    with written_whole(path) as new:
        new.write_text(text, newline="", encoding="utf-8")


def _read(path: Path) -> str:
    """Read a file with its own line endings."""
    return read_text(path, "config", "name the config of that method")
