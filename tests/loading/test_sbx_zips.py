"""Zips of SBX are recognised by their names alone, so also where SBX is not installed."""

from __future__ import annotations

import json
import sys
import zipfile
from pathlib import Path

import pytest
from support import make, run_command

from sb3_sparse.errors import CorruptStateError, UnsupportedError
from sb3_sparse.loading.sbx import is_sbx, sbx_algorithms
from sb3_sparse.loading.zips import look_into, read_model

PLAIN = "not a pickle"


def written(module, kind="abc.ABCMeta"):
    """A class as SB3 writes it into a zip."""
    return {":type:": f"<class '{kind}'>", ":serialized:": PLAIN, "__module__": module}


@pytest.fixture
def zip_of(tmp_path):
    def write(data, **members) -> Path:
        path = tmp_path / "model.zip"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("data", data if isinstance(data, str) else json.dumps(data))
            for name, content in members.items():
                archive.writestr(name.replace("_pth", ".pth"), content)
        return path

    return write


@pytest.mark.parametrize(
    ("module", "algos"),
    [
        ("sbx.sac.policies", ["sac"]),
        ("sbx.td3.policies", ["td3", "ddpg"]),
        ("sbx.ppo.policies", ["ppo"]),
        ("sbx.dqn.policies", ["dqn"]),
        ("sbx.tqc.policies", ["tqc"]),
        ("sbx.crossq.policies", ["crossq"]),
    ],
)
def test_the_policy_class_names_the_algorithm(zip_of, module, algos):
    path = zip_of({"gamma": 0.99, "policy_class": written(module)})
    assert is_sbx(path)
    assert sbx_algorithms(path) == algos


def test_a_policy_of_ones_own_is_known_by_what_it_consists_of(zip_of):
    data = {
        "policy_class": written("my.policies"),
        "actor": {":type:": "<class 'sbx.common.policies.SquashedGaussianActor'>"},
        "ent_coef": {":type:": "<class 'sbx.sac.sac.EntropyCoef'>"},
    }
    assert sbx_algorithms(zip_of(data)) == ["sac"]


def test_an_algorithm_that_is_not_known_is_an_error(zip_of):
    path = zip_of({"policy_class": written("sbx.dreamer.policies")})
    with pytest.raises(UnsupportedError, match="no algorithm of SBX that is known; known are dqn"):
        sbx_algorithms(path)


def test_zips_of_sb3_and_other_files_are_not_of_sbx(zip_of, tmp_path):
    make("DQN").save(tmp_path / "stock.zip")
    (tmp_path / "text.zip").write_text("text")
    assert not is_sbx(tmp_path / "stock.zip")
    assert not is_sbx(tmp_path / "text.zip")
    assert not is_sbx(tmp_path / "none.zip")
    assert not is_sbx(tmp_path)
    assert not is_sbx(zip_of({"policy_class": written("sbx.sac.policies")}, policy_pth="x"))
    for damaged in ("[", "[1]", json.dumps({"policy_class": [1], "gamma": {":type:": 3}})):
        assert not is_sbx(zip_of(damaged))
        with pytest.raises(CorruptStateError, match="is damaged"):
            look_into(zip_of(damaged))


def test_only_sb3_zips_are_read_as_such(zip_of):
    path = zip_of({"policy_class": written("sbx.sac.policies")})
    for read in (look_into, read_model):
        with pytest.raises(UnsupportedError, match="is a model of SBX .* --to dense sb3.zip`"):
            read(path)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (["inspect"], "is a model of SBX (SB3 in JAX), which only `sb3-sparse export` and `enjoy`"),
        (["compress", "--env", "Pendulum-v1"], "is a model of SBX (SB3 in JAX), which only"),
        (["export"], "a model of SBX needs sb3-sparse[sbx]: pip install 'sb3-sparse[sbx]'"),
        (
            ["enjoy", "--env", "Pendulum-v1", "-n", "1"],
            "a model of SBX needs sb3-sparse[sbx]: pip install 'sb3-sparse[sbx]'",
        ),
        (["export", "--algo", "td3"], "is a model of sac, not of td3; leave --algo out"),
    ],
)
def test_commands_say_what_to_do(zip_of, command, message, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "sbx", None)  # as if it were not installed
    path = zip_of({"policy_class": written("sbx.sac.policies"), "n_envs": 1})
    code, _, errors = run_command(monkeypatch, capsys, command[0], path, *command[1:])
    assert code == 2
    (line,) = errors.strip().splitlines()
    assert line.startswith("Error: ")
    assert message in line
