"""Damaged files of a run: every command names the file in one line, and never shows a traceback."""

from __future__ import annotations

import json
import pickle
import shutil
import zipfile

import numpy as np
import pytest
import yaml
from support import run_command

from sb3_sparse.report.reading import read_runs
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.training import train

ENV = "Pendulum-v1"
COMMANDS = {
    "enjoy": ["enjoy", "-n", "1"],
    "inspect": ["inspect"],
    "export": ["export", "OUT", "--to", "numpy"],
    "compress": ["compress", "--steps", "64", "--sparsity", "0.8", "--eval-episodes", "2"],
    "resume": ["train", "--resume"],
}
READS = {
    f"{ENV}.zip": ("enjoy", "inspect", "export", "compress"),
    f"{ENV}/args.yml": ("enjoy", "inspect", "export", "compress"),
    f"{ENV}/config.yml": ("enjoy", "export", "compress"),
    f"{ENV}/vecnormalize.pkl": ("enjoy", "export", "compress"),
    "sparsity.json": ("resume",),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    settings = dict(normalize=True, n_steps=64, batch_size=32, net_arch=[8])
    run = RunSpec(
        algo="ppo",
        env_id=ENV,
        method="static",
        sparsity=0.5,
        n_timesteps=128,
        eval_freq=64,
        eval_episodes=1,
        hyperparams=settings,
    )
    return train(run, tmp_path_factory.mktemp("logs")).folder


@pytest.fixture
def folder(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "ppo" / "run")


@pytest.fixture
def said(monkeypatch, capsys, tmp_path):
    """Runs a command on a folder, and gives its exit code and errors."""

    def call(command, folder):
        name, *rest = COMMANDS[command]
        arguments = [str(tmp_path / "out") if one == "OUT" else one for one in rest]
        where = [str(folder), *arguments] if name != "train" else [*arguments, str(folder)]
        code, _, errors = run_command(monkeypatch, capsys, name, *where)
        return code, errors

    return call


def flipped(content, place):
    return content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :]


DAMAGE = {
    "empty": lambda c: b"",
    "half": lambda c: c[: len(c) // 2],
    "a tail lacks": lambda c: c[:-3],
    "binary": lambda c: bytes(range(256)) * 4,
    "latin-1": lambda c: "größe: 3\n".encode("latin-1"),
    "utf-16": lambda c: "algo: ppo\n".encode("utf-16"),
    "a list": lambda c: b"[1, 2]",
    "a flipped head": lambda c: flipped(c, 0),
    "a flipped middle": lambda c: flipped(c, len(c) // 2),
    "an unclosed bracket": lambda c: b"{[\n",
    "an open pickle": lambda c: b"\x80\x04(",
    "another pickle": lambda c: pickle.dumps({"mean": np.zeros(3)}),
}
HARMLESS = {  # a flipped byte or lost lines may leave a file that says something still
    (f"{ENV}/config.yml", "half"),
    (f"{ENV}/args.yml", "half"),
    (f"{ENV}/config.yml", "a tail lacks"),
    (f"{ENV}/config.yml", "a flipped middle"),
    (f"{ENV}/args.yml", "a tail lacks"),
    (f"{ENV}/args.yml", "a flipped middle"),
    (f"{ENV}/vecnormalize.pkl", "a flipped middle"),
    (f"{ENV}.zip", "a flipped middle"),
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("name", READS)
def test_damaged_bytes_are_one_line_that_names_the_file(name, damage, folder, said):
    path = folder / name
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    for command in READS[name]:
        code, errors = said(command, folder)
        if code == 0 and (name, damage) in HARMLESS:
            continue
        assert code == 2, (command, errors)
        lines = [line for line in errors.splitlines() if line.startswith("Error: ")]
        assert len(lines) == 1, (command, errors)
        assert "Traceback" not in errors
        assert str(path) in lines[0] or (name, damage) in HARMLESS, (command, lines)


def changed_yaml(**values):
    def change(content):
        return yaml.dump({**yaml.unsafe_load(content), **values}).encode()

    return change


def changed_json(**values):
    def change(content):
        return json.dumps({**json.loads(content), **values}).encode()

    return change


def changed_zip(*, without=(), **members):
    def change(path):
        with zipfile.ZipFile(path) as old:
            kept = {name: old.read(name) for name in old.namelist() if name not in without}
        data = json.loads(kept.get("data", b"{}"))
        for name, value in members.items():
            data[name] = value
        if "data" in kept:
            kept["data"] = json.dumps(data).encode()
        with zipfile.ZipFile(path, "w") as new:
            for name, content in kept.items():
                new.writestr(name, content)

    return change


@pytest.mark.parametrize(
    ("name", "change", "commands"),
    [
        (f"{ENV}/args.yml", changed_yaml(env=3), ("enjoy", "inspect", "export")),
        (f"{ENV}/args.yml", changed_yaml(algo=None), ("enjoy", "export")),
        (f"{ENV}/args.yml", changed_yaml(algo="dreamer"), ("enjoy", "export")),
        (f"{ENV}/args.yml", changed_yaml(env_kwargs=[1]), ("enjoy", "export", "compress")),
        (f"{ENV}/config.yml", changed_yaml(frame_stack="four"), ("enjoy", "export", "compress")),
        (f"{ENV}/config.yml", changed_yaml(env_wrapper=[{"a": 1, "b": 2}]), ("enjoy", "export")),
        (f"{ENV}/config.yml", changed_yaml(env_kwargs="g=3"), ("enjoy", "compress")),
        ("sparsity.json", changed_json(status=7), ("resume",)),
        ("sparsity.json", changed_json(status="running", run=[1]), ("resume",)),
        ("sparsity.json", changed_json(status="running", run={"speed": 3}), ("resume",)),
        ("sparsity.json", changed_json(status="running", settings=None), ("resume",)),
        ("sparsity.json", changed_json(status="running", evaluation={}), ("resume",)),
    ],
)
def test_wrong_types_are_one_line_that_names_the_file(name, change, commands, folder, said):
    path = folder / name
    path.write_bytes(change(path.read_bytes()))
    for command in commands:
        code, errors = said(command, folder)
        assert code == 2, (command, errors)
        assert errors.startswith("Error: "), (command, errors)
        assert str(path) in errors, (command, errors)


@pytest.mark.parametrize(
    ("change", "commands"),
    [
        (changed_zip(without=("policy.pth",)), ("enjoy", "inspect", "export", "compress")),
        (changed_zip(without=("data",)), ("enjoy", "inspect", "export", "compress")),
        (changed_zip(observation_space=3), ("enjoy", "export", "compress")),
        (changed_zip(policy_class="SparsePolicy"), ("enjoy", "export", "compress")),
        (changed_zip(policy_kwargs={"sparsity": 7}), ("enjoy", "export", "compress")),
        (changed_zip(policy_kwargs={"net_arch": "wide"}), ("enjoy", "export", "compress")),
        (changed_zip(n_envs=None), ("compress",)),
        (changed_zip(gamma=5.0), ("compress",)),
        (changed_zip(max_grad_norm={"a": 1}), ("compress",)),
        (changed_zip(num_timesteps="many"), ("compress",)),
    ],
)
def test_wrong_members_of_a_zip_are_one_line_that_names_it(change, commands, folder, said):
    path = folder / f"{ENV}.zip"
    change(path)
    for command in commands:
        code, errors = said(command, folder)
        assert code == 2, (command, errors)
        (line,) = [line for line in errors.splitlines() if line.startswith("Error: ")]
        assert str(path) in line or "--n-envs" in line


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("name", ["sparsity.json", "evaluations.npz"])
def test_a_damaged_record_never_ends_a_report(name, damage, folder, whole):
    path = folder / name
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    runs, left_out = read_runs([whole, folder])
    assert whole in [run.folder for run in runs]
    if folder not in [run.folder for run in runs]:
        (one,) = left_out
        assert one.folder == folder
        assert one.reason.startswith((name, "duplicate")), one.reason


@pytest.mark.parametrize(
    "values",
    [
        {"run": {"algo": "ppo", "env_id": ENV, "seed": "x"}},
        {"run": {"algo": 3, "env_id": [ENV], "seed": None}},
        {"layers": 3},
        {"layers": [3]},
        {"layers": [{"network": "actor"}]},
        {"layers": [{"network": "actor", "nnz": "many", "shape": [3, 3], "name": "a"}]},
        {"layers": [{"network": "actor", "nnz": 3, "shape": [-3, "x"], "name": "a"}]},
        {"total": {"sparsity": "half", "parameters": {}, "flops": [], "dense_flops": None}},
        {"total": {"sparsity": float("nan"), "parameters": 3, "flops": 3}},
        {"settings": [1]},
        {"settings": {"policy_kwargs": 3}},
        {"settings": {"n_timesteps": "long"}},
        {"method": {"a": 1}, "layers": None},
    ],
)
def test_wrong_types_in_a_record_never_end_a_report(values, folder, whole):
    path = folder / "sparsity.json"
    path.write_bytes(changed_json(**values)(path.read_bytes()))
    runs, left_out = read_runs([whole, folder])
    assert [run.folder for run in runs] == [whole]
    assert [one.folder for one in left_out] == [folder]


def test_an_error_of_our_own_still_shows_a_traceback(folder, said, monkeypatch):
    def broken(*_):
        raise RuntimeError("a mistake of ours")

    monkeypatch.setattr("sb3_sparse.zoo.outline._specs", broken)
    with pytest.raises(RuntimeError, match="a mistake of ours"):
        said("inspect", folder)
