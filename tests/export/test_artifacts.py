"""The files on their own: without this package, and the same each time."""

import base64
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import onnx
import pytest
from support import TinyImages, make

from sb3_sparse import SparsityCallback
from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export import FORMATS, export_policy, numpy_policy

BLOCKED = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {names}:
            raise ImportError(name)
sys.meta_path.insert(0, Absent())
"""


def python(code, folder, *blocked):
    """Run Python where some packages are not installed."""
    done = subprocess.run(
        [sys.executable, "-c", BLOCKED.format(names=blocked) + code],
        cwd=folder,
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_loader_is_short_and_needs_numpy_only():
    text = Path(numpy_policy.__file__).read_text()
    assert len(text.splitlines()) <= 100
    assert "pickle" not in text


@pytest.mark.parametrize("blocked", [(), ("scipy",)], ids=["scipy", "numpy only"])
@pytest.mark.parametrize(
    ("algorithm", "env"),
    [("SAC", "Pendulum-v1"), ("SAC", TinyImages(False)), ("DQN", "CartPole-v1")],
    ids=["vectors", "images", "discrete"],
)
def test_the_loader_runs_with_and_without_scipy(algorithm, env, blocked, tmp_path):
    model = make(algorithm, env, policy_kwargs=dict(sparsity=0.8))
    export_policy(model, tmp_path / "policy", "numpy")
    assert {path.name for path in tmp_path.iterdir()} == {"policy.npz", "numpy_policy.py"}
    model.observation_space.seed(0)
    seen = np.stack([model.observation_space.sample() for _ in range(6)])
    np.save(tmp_path / "seen.npy", seen)
    code = """
import numpy as np
from numpy_policy import Policy
seen = np.load("seen.npy")
policy = Policy("policy.npz")
np.savez("actions.npz", many=policy(seen), one=policy(seen[0]))
assert ("scipy" in sys.modules) == SCIPY
assert not {"torch", "sb3_sparse", "gymnasium"} & set(sys.modules)
"""
    python(code.replace("SCIPY", str(not blocked)), tmp_path, *blocked)
    with np.load(tmp_path / "actions.npz") as found:
        many, one = found["many"], found["one"]
    expected, _ = model.predict(seen, deterministic=True)
    np.testing.assert_allclose(many, expected, atol=1e-5)
    np.testing.assert_allclose(one, expected[0], atol=1e-5)
    np.load(tmp_path / "policy.npz", allow_pickle=False)["ops"]


TRAIN_ON = """
import gymnasium, numpy as np, sb3_contrib, stable_baselines3
for name, env in CASES:
    algorithm = getattr(stable_baselines3, name, None) or getattr(sb3_contrib, name)
    model = algorithm.load(f"{name}.zip", env=gymnasium.make(env))
    np.save(f"{name}.npy", model.predict(np.load(f"{name}_seen.npy"), deterministic=True)[0])
    owner = getattr(model, "actor", None) or model.policy
    before = [p.detach().clone() for p in owner.parameters()]
    moments = [s["exp_avg"].abs().sum().item() for s in owner.optimizer.state.values()]
    assert sum(moments) > 0
    steps = model.num_timesteps
    model.learn(64, reset_num_timesteps=False)
    assert model.num_timesteps > steps
    assert any((p != b).any() for p, b in zip(owner.parameters(), before))
    model.save("again.zip")
assert not any(name.split(".")[0] == "sb3_sparse" for name in sys.modules)
"""


def test_dense_zips_go_on_training_without_this_package(tmp_path):
    models, cases = {}, []
    for name in ("PPO", "SAC", "DQN", "CrossQ"):
        model = models[name] = make(name, learning_rate=lambda progress: 1e-3 * progress)
        model.learn(64, callback=SparsityCallback("rigl", update_interval=3))
        export_policy(model, tmp_path / name, "dense")
        seen = np.random.default_rng(0).normal(size=(20, *model.observation_space.shape))
        np.save(tmp_path / f"{name}_seen.npy", seen.astype(np.float32))
        cases.append((name, model.env.envs[0].unwrapped.spec.id))
    python(TRAIN_ON.replace("CASES", repr(cases)), tmp_path, "sb3_sparse")
    for name, model in models.items():
        seen = np.load(tmp_path / f"{name}_seen.npy")
        expected, _ = model.predict(seen, deterministic=True)
        np.testing.assert_array_equal(np.load(tmp_path / f"{name}.npy"), expected)


def test_a_dense_zip_keeps_each_moment_with_its_weight(tmp_path):
    model = make("SAC", policy_kwargs=dict(compute="sparse"))
    model.learn(60)
    report = export_policy(model, tmp_path / "dense", "dense")
    assert report.nnz == sum(int(layer.mask().sum()) for layer in model.policy.sparse.layers)
    stock = type(model).load(tmp_path / "dense.zip")
    sparse = dict(model.policy.actor.named_parameters())
    checked = 0
    for name, parameter in stock.policy.actor.named_parameters():
        ours = model.policy.actor.optimizer.state[sparse[name]]["exp_avg_sq"]
        layer = next((la for la in model.policy.sparse.layers if la.weight is sparse[name]), None)
        if layer is not None:
            dense = np.zeros(layer.size, np.float32)
            dense[layer.mask()] = ours.numpy()
            ours, checked = dense.reshape(layer.shape), checked + 1
        theirs = stock.policy.actor.optimizer.state[parameter]["exp_avg_sq"]
        np.testing.assert_array_equal(np.asarray(theirs), np.asarray(ours))
    assert checked == 4


def test_a_dense_zip_cannot_hold_networks_of_this_package(tmp_path):
    kwargs = dict(features_extractor_class="sb3_sparse.networks.ScaledNatureCNN")
    with pytest.raises(UnsupportedError, match="policy_kwargs.*needs sb3_sparse"):
        export_policy(make("DQN", TinyImages(), policy_kwargs=kwargs), tmp_path / "dense", "dense")
    assert not list(tmp_path.iterdir())


def test_two_exports_of_a_model_are_the_same_to_the_byte(tmp_path):
    formats = {
        "SparsePolicy": FORMATS,
        "SparseSimbaPolicy": [to for to in FORMATS if to != "dense"],
    }
    for policy in formats:
        arguments = dict(learning_rate=lambda progress: 1e-3, tensorboard_log=str(tmp_path / "tb"))
        make("PPO", policy=policy, **arguments).learn(64).save(tmp_path / f"{policy}.zip")
    code = f"""
import sb3_sparse
from stable_baselines3 import PPO
from sb3_sparse.export import export_policy
for policy, formats in {formats!r}.items():
    model = PPO.load(f"../{{policy}}.zip")
    for to in formats:
        export_policy(model, f"{{policy}}/{{to}}", to)
"""
    for seed in "12":
        for policy in formats:
            (tmp_path / seed / policy).mkdir(parents=True)
        environment = {**os.environ, "PYTHONHASHSEED": seed, "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-c", code]
        subprocess.run(command, cwd=tmp_path / seed, check=True, env=environment)
    for policy in formats:
        first, second = (sorted((tmp_path / seed / policy).iterdir()) for seed in "12")
        dense = ["dense.zip"] if "dense" in formats[policy] else []
        names = ["c.c", "c.h", *dense, "numpy.npz", "numpy_policy.py", "onnx.onnx"]
        assert [path.name for path in first] == names
        for one, other in zip(first, second, strict=True):
            assert one.read_bytes() == other.read_bytes(), (policy, one.name)
            for place in (tmp_path, Path(__file__).parent, sys.prefix, Path.home()):
                assert str(place).encode() not in contents(one), (policy, one.name, place)


def contents(path):
    """The bytes of a file, those of a zip unpacked and its pickles decoded."""
    if path.suffix != ".zip":
        return path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        parts = [archive.read(name) for name in archive.namelist()]
        data = json.loads(archive.read("data"))
    pickles = [v[":serialized:"] for v in data.values() if ":serialized:" in str(v)]
    assert pickles
    return b"".join([*parts, *map(base64.b64decode, pickles)])


def test_a_schedule_written_in_a_script_works_in_a_dense_zip(tmp_path):
    export_policy(
        make("PPO", learning_rate=lambda progress: 1e-3 * progress), tmp_path / "d", "dense"
    )
    loaded = make("PPO").load(tmp_path / "d.zip")
    assert loaded.lr_schedule(0.5) == 5e-4


@pytest.mark.parametrize("env", ["CartPole-v1", TinyImages()], ids=["vectors", "images"])
def test_onnx_models_name_their_input_and_output(env, tmp_path):
    export_policy(make("DQN", env), tmp_path / "policy", "onnx")
    model = onnx.load(tmp_path / "policy.onnx")
    (obs,), (action,) = model.graph.input, model.graph.output
    images = env != "CartPole-v1"
    assert (obs.name, action.name) == ("obs", "action")
    kinds = onnx.TensorProto
    assert obs.type.tensor_type.elem_type == (kinds.UINT8 if images else kinds.FLOAT)
    assert action.type.tensor_type.elem_type == kinds.INT64
    assert not model.doc_string
