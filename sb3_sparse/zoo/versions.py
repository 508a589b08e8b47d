"""The versions that a run is trained by: Python, packages, and the commit of this one."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Mapping
from importlib.metadata import Distribution, PackageNotFoundError, distribution, version
from pathlib import Path

NAME = "sb3-sparse"
PACKAGES = (NAME, "stable-baselines3", "sb3-contrib", "rl_zoo3", "torch", "gymnasium", "numpy")
DIGITS = 12
UNKNOWN, THEN = "unknown", ", then "
TIMEOUT = 5.0
"""Seconds after which git has failed."""


def commit_of(package: Path) -> str | None:
    """Return the commit that a package is of, or None if nothing tells.

    That of an installation from a repository is in its metadata (PEP 610). That of a checkout is
    git's HEAD, with " changed" behind it if tracked files of the package differ from it.

    :param package: the package's folder
    """
    try:
        installed = distribution(NAME)
    except PackageNotFoundError:
        return _by_git(package)
    return _by_metadata(installed, package) or _by_git(package)


def versions() -> dict[str, str]:
    """Return the versions of Python and of every package that affects a run, and the commit.

    The commit is left out if nothing tells it.
    """
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found if COMMIT is None else {**found, "commit": COMMIT}


def continued(before: Mapping[str, str]) -> dict[str, str]:
    """Return the versions of a run that this process continues, e.g. ``"2.12.0, then 2.13.0"``.

    :param before: its versions so far; a name that it lacks was unknown
    """
    found = {**before}
    for name, now in versions().items():
        known = before.get(name, UNKNOWN)
        found[name] = known if known.split(THEN)[-1] == now else f"{known}{THEN}{now}"
    return found


def _by_metadata(installed: Distribution, package: Path) -> str | None:
    """Return the commit in an installation's metadata, if the package is the installed one."""
    if Path(str(installed.locate_file(package.name))).resolve() != package.resolve():
        return None
    try:
        origin = json.loads(installed.read_text("direct_url.json") or "")
        return str(origin["vcs_info"]["commit_id"])[:DIGITS]
    except (ValueError, KeyError, TypeError):  # it was installed from elsewhere
        return None


def _by_git(package: Path) -> str | None:
    try:
        # fails if the package is only somewhere below a repository, as in a virtual environment
        _git(package, "ls-files", "--error-unmatch", "--", "__init__.py")
        head = _git(package, "rev-parse", "--verify", "HEAD")[:DIGITS]
        changed = _git(package, "status", "--porcelain", "--untracked-files=no", "--", ".")
    except (OSError, subprocess.SubprocessError):
        return None
    return f"{head} changed" if changed else head


def _git(folder: Path, *words: str) -> str:
    """Return what git prints. It takes no locks that others may need.

    :raises OSError: if there is no git
    :raises subprocess.SubprocessError: if it fails, or does not answer
    """
    command = ["git", "-c", "core.fsmonitor=false", *words]
    here = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    return subprocess.run(
        command,
        cwd=folder,
        env={**here, "GIT_OPTIONAL_LOCKS": "0"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        encoding="utf-8",
        errors="replace",
        check=True,
        timeout=TIMEOUT,
    ).stdout.strip()


COMMIT = commit_of(Path(__file__).parents[1])
"""The commit of the code that is loaded. HEAD moves while a process trains for hours."""
