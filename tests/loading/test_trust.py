"""Files of strangers: what looks into them runs nothing, whatever they say."""

from __future__ import annotations

import base64
import json
import os
import pickle
import sys
import zipfile
from pathlib import Path

import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from support import ALGORITHMS, make
from torch import nn

from sb3_sparse import SparseSACPolicy, cli
from sb3_sparse.errors import ConfigError, CorruptStateError
from sb3_sparse.loading.zooyaml import NotBuilt, read_zoo_yaml
from sb3_sparse.zoo.inspection import inspect_model
from sb3_sparse.zoo.saved_by import algos_of
from sb3_sparse.zoo.wrappers import check_wrappers


class Payload:
    """Touches a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return (os.mkdir, (str(self.path),))


def with_payload(path: Path, ran: Path) -> None:
    """Every pickle in the zip of a model becomes one that runs."""
    with zipfile.ZipFile(path) as old:
        members = {name: old.read(name) for name in old.namelist()}
    data = json.loads(members["data"])
    text = base64.b64encode(pickle.dumps(Payload(ran))).decode()
    for value in data.values():
        if isinstance(value, dict) and ":serialized:" in value:
            value[":serialized:"] = text
    members["data"] = json.dumps(data).encode()
    with zipfile.ZipFile(path, "w") as new:
        for name, content in members.items():
            new.writestr(name, content)


def test_inspect_runs_no_pickle_of_a_zip(tmp_path):
    make("SAC").save(tmp_path / "model.zip")
    before = str(inspect_model(tmp_path / "model.zip"))
    with_payload(tmp_path / "model.zip", tmp_path / "ran")
    assert str(inspect_model(tmp_path / "model.zip")) == before
    assert not (tmp_path / "ran").exists()
    with pytest.raises((ConfigError, CorruptStateError)):  # SB3's own way runs it
        algos_of(tmp_path / "model.zip")
    assert (tmp_path / "ran").exists()


def test_inspect_runs_no_pickle_in_place_of_the_weights(tmp_path):
    ran = tmp_path / "ran"
    make("DQN").save(tmp_path / "model.zip")
    with zipfile.ZipFile(tmp_path / "model.zip") as old:
        data = old.read("data")
    th.save({"q_net.weight": Payload(ran)}, tmp_path / "policy.pth")
    with zipfile.ZipFile(tmp_path / "model.zip", "w") as new:
        new.writestr("data", data)
        new.write(tmp_path / "policy.pth", "policy.pth")
    with pytest.raises(CorruptStateError, match="is damaged, or holds no model saved by SB3"):
        inspect_model(tmp_path / "model.zip")
    assert not ran.exists()


def run_folder(tmp_path: Path, arguments: str, settings: str) -> Path:
    folder = tmp_path / "run"
    (folder / "CartPole-v1").mkdir(parents=True)
    make("DQN").save(folder / "CartPole-v1.zip")
    (folder / "CartPole-v1" / "args.yml").write_text(arguments)
    (folder / "CartPole-v1" / "config.yml").write_text(settings)
    return folder


ORDERED = "!!python/object/apply:collections.OrderedDict\n- - [algo, dqn]\n  - [env, CartPole-v1]\n"


@pytest.mark.parametrize("place", ["args", "config"])
@pytest.mark.parametrize("command", ["inspect", "export", "compress", "enjoy"])
def test_no_command_runs_what_yaml_says(command, place, tmp_path, monkeypatch):
    ran = tmp_path / "ran"
    payload = f"  - [more, !!python/object/apply:os.mkdir [{str(ran)!r}]]\n"
    texts = {"args": ORDERED, "config": ORDERED}
    texts[place] += payload
    folder = run_folder(tmp_path, texts["args"], texts["config"])
    monkeypatch.chdir(tmp_path)
    few = ["--steps", "32", "--eval-episodes", "2", "--sparsity", "0.95"]
    more = {"enjoy": ["-n", "1"], "export": ["out", "--to", "numpy"], "compress": few}
    arguments = [command, str(folder), *more.get(command, [])]
    monkeypatch.setattr(sys, "argv", ["sb3-sparse", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 0
    assert not ran.exists()


def test_the_tags_that_rl_zoo_writes_are_read(tmp_path):
    path = tmp_path / "config.yml"
    path.write_text(
        ORDERED + "  - [sizes, !!python/tuple [3, 4]]\n"
        "  - [activation, !!python/name:torch.nn.modules.activation.ReLU '']\n"
        "  - [other, !!python/object/apply:os.system ['true']]\n"
    )
    assert read_zoo_yaml(path, "") == {
        "algo": "dqn",
        "env": "CartPole-v1",
        "sizes": (3, 4),
        "activation": "torch.nn.modules.activation.ReLU",
        "other": NotBuilt("object/apply:os.system"),
    }


def test_a_python_object_where_it_would_be_used_is_refused(tmp_path, monkeypatch, mistake):
    settings = "env_wrapper: !!python/object/apply:os.mkdir [ran]\n"
    folder = run_folder(tmp_path, ORDERED, settings)
    said = mistake("enjoy", str(folder))
    assert "config.yml asks for the Python object 'object/apply:os.mkdir'" in said
    assert not (tmp_path / "ran").exists()


def test_a_wrapper_must_be_one():
    check_wrappers({"env_wrapper": ["gymnasium.wrappers.FlattenObservation"]})
    with pytest.raises(ConfigError, match=r"timeit\.timeit is not a subclass of gymnasium"):
        check_wrappers({"env_wrapper": [{"timeit.timeit": {"setup": "print('run')"}}]})


IMPALA = {"features_extractor_class": "sb3_sparse.networks.ImpalaCNN", "net_arch": []}
NARROW = {
    "features_extractor_class": "sb3_sparse.networks.ScaledNatureCNN",
    "features_extractor_kwargs": {"channels": [3, 4, 5], "features_dim": 7},
}


@pytest.mark.parametrize(
    ("algorithm", "env", "kwargs"),
    [
        *((name, None, {}) for name in ALGORITHMS),
        ("SAC", None, {"dense_layers": ["output"], "compute": "sparse"}),
        ("SAC", None, {"use_sde": True}),
        ("PPO", None, {"net_arch": []}),
        ("PPO", "TinyDicts-v0", {}),
        ("PPO", "TinyImages-v0", {}),
        ("PPO", "TinyImages-v0", {"share_features_extractor": False}),
        ("SAC", "TinyImages-v0", {"share_features_extractor": True}),
        ("DQN", "TinyImages-v0", {}),
        ("DQN", "TinyImages-v0", {"compute": "sparse"}),
        ("DQN", "TinyImages-v0", IMPALA),
        ("DQN", "TinyImages-v0", {**IMPALA, "compute": "sparse"}),
        ("DQN", "TinyImages-v0", NARROW),
    ],
)
def test_what_is_own_attribute_names_and_shapes_is_the_policys_own_report(
    algorithm, env, kwargs, tmp_path
):
    discrete = algorithm in ("DQN", "PPO")
    made = None if env is None else make_vec_env(env, env_kwargs={"discrete": discrete})
    model = make(algorithm, made, policy_kwargs=kwargs)
    model.save(tmp_path / "model.zip")
    found = inspect_model(tmp_path / "model.zip")
    assert found.report == model.policy.sparsity_report()
    assert found.compute == kwargs.get("compute", "auto")


@pytest.mark.parametrize("width", [16, 200])
@pytest.mark.parametrize("algorithm", sorted({*ALGORITHMS} - {"CrossQ"}))
def test_simba_networks_are_reported_as_by_the_policy_itself(algorithm, width, tmp_path):
    kwargs = {"net_arch": [width, width]}
    model = make(algorithm, policy="SparseSimbaPolicy", policy_kwargs=kwargs)
    model.save(tmp_path / "model.zip")
    assert inspect_model(tmp_path / "model.zip").report == model.policy.sparsity_report()


class Own(BaseFeaturesExtractor):
    """An extractor of the user's, of which nobody knows what it does with its layers."""

    def __init__(self, space):
        super().__init__(space, 200)
        self.layers = nn.Sequential(nn.Linear(space.shape[0], 200), nn.ReLU(), nn.Linear(200, 200))

    def forward(self, x):
        return self.layers(x)


class OwnPolicy(SparseSACPolicy):
    """The same of a policy."""


@pytest.mark.parametrize("policy", ["SparsePolicy", OwnPolicy])
def test_layers_in_modules_of_the_users_are_told_as_the_policy_has_them(policy, tmp_path):
    kwargs = dict(sparsity=0.9, net_arch=[200, 200], features_extractor_class=Own)
    model = SAC(policy, "Pendulum-v1", policy_kwargs=kwargs, buffer_size=10, device="cpu")
    model.save(tmp_path / "model.zip")
    own = {r.name: r.compute for r in model.policy.sparsity_report().layers}
    found = inspect_model(tmp_path / "model.zip").report.layers
    assert {r.name: r.compute for r in found} == own
    assert ("sparse" in own.values()) == (policy == "SparsePolicy")


def test_convolutions_of_unknown_strides_have_no_flops_but_all_else(tmp_path):
    model = make("DQN", "TinyImages-v0")
    model.observation_space = None  # and so is not in the zip as a space with a shape
    model.save(tmp_path / "model.zip")
    report = inspect_model(tmp_path / "model.zip").report
    own = model.policy.sparsity_report()
    assert [(r.name, r.shape, r.nnz) for r in report.layers] == [
        (r.name, r.shape, r.nnz) for r in own.layers
    ]
    assert [r.flops for r in report.layers if len(r.shape) == 4] == [0, 0, 0]
    assert str(report).count("?") == 2 * 4  # three convolutions and the total
