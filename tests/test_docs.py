"""What the documents show runs, and what they say is there is there."""

from __future__ import annotations

import doctest
import inspect
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from contextlib import redirect_stdout
from importlib import import_module
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DQN, SAC
from support import arguments_of, assert_masked, make

from sb3_sparse import SparsePolicy, cli
from sb3_sparse.analysis import flops
from sb3_sparse.export import export_policy
from sb3_sparse.policies import registry as algorithms_registry
from sb3_sparse.topology import registry
from sb3_sparse.tuning import space_of
from sb3_sparse.tuning.spaces import check_space
from sb3_sparse.tuning.tuner import define
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.training import train

ROOT = Path(__file__).parent.parent
DOORS = ["", ".algorithms", ".analysis", ".buffers", ".callbacks", ".compress", ".export"]
DOORS += [".fused", ".networks", ".report"]
DOORS += [".sparsity", ".studies", ".topology", ".tuning", ".zoo"]


def public_classes() -> dict[str, type]:
    """Every class that a package of :data:`DOORS` exports, by the name that users import."""
    found: dict[type, str] = {}
    for door in DOORS:
        module = import_module(f"sb3_sparse{door}")
        for name in getattr(module, "__all__", ()):
            one = getattr(module, name)
            if isinstance(one, type) and not issubclass(one, Exception):
                found.setdefault(one, f"sb3_sparse{door}.{name}")
    return {name: one for one, name in found.items()}


PUBLIC = public_classes()


def example_of(cls: type) -> str:
    """The block below ``Example::`` in a docstring, or what its ``>>>`` lines say; "" if none."""
    text = inspect.cleandoc(cls.__dict__.get("__doc__") or "")
    _, _, block = text.partition("Example::\n")
    code = list(takewhile(is_of_block, block.splitlines()))
    return textwrap.dedent("\n".join(code)).strip() if code else ">>>" * (">>>" in text)


def is_of_block(line: str) -> bool:
    return not line or line.startswith(" ")


def test_every_public_class_has_an_example():
    assert not [name for name, cls in PUBLIC.items() if not example_of(cls)]


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_the_example_of_a_public_class_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "_METHODS", dict(registry._METHODS))
    cls = PUBLIC[name]
    code = example_of(cls)
    if code != ">>>":
        exec(compile(code, name, "exec"), {"__name__": "example"})
        return
    text = inspect.cleandoc(cls.__doc__ or "")
    found = doctest.DocTestParser().get_doctest(text, {}, name, None, None)
    said: list[str] = []
    doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(found, out=said.append)
    assert not said, "".join(said)


def python_blocks(path: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / path).read_text(), re.DOTALL)


def test_the_example_of_the_readme_runs(capsys):
    (code,) = python_blocks("README.md")
    small = code.replace("1_000_000", "150").replace("HalfCheetah-v5", "Pendulum-v1")
    assert small.count("150") == 1
    exec(compile(small, "README.md", "exec"), {})
    assert "sparsity: actor 0.9" in capsys.readouterr().out


def test_the_example_of_the_first_page_runs(capsys):
    (code,) = python_blocks("docs/index.md")
    assert code.count("5_000") == 1
    exec(compile(code.replace("5_000", "150"), "docs/index.md", "exec"), {})
    assert "sparsity: actor 0.9" in capsys.readouterr().out


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """The folder of somebody who followed the tutorial up to the board, and what was printed."""
    text = (ROOT / "docs/tutorial.md").read_text()
    folder = tmp_path_factory.mktemp("tutorial")
    for kind, name in (("python", "docking.py"), ("c", "main.c")):
        (code,) = re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL)
        (folder / name).write_text(code)
    shutil.copytree(ROOT / "examples/microcontroller", folder / "examples/microcontroller")
    _, *steps, _ = tutorial_steps()
    assert "".join(steps).count("-n 5000") == 1
    commands = "".join(steps).replace("-n 5000", "-n 300 --eval-episodes 2")
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as said:
        patch.chdir(folder)
        patch.syspath_prepend(folder)
        for line in commands.replace("\\\n", " ").splitlines():
            if line.startswith("sb3-sparse"):
                cli.app(shlex.split(line)[1:], standalone_mode=False)
            else:
                print(shell(line, folder))
    return folder, said.getvalue()


def tutorial_steps() -> list[str]:
    return re.findall(r"```sh\n(.*?)```", (ROOT / "docs/tutorial.md").read_text(), re.DOTALL)


def shell(commands: str, folder: Path) -> str:
    """Run commands as a user does who has installed this package."""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    commands = re.sub(r"(PYTHONPATH=\S+)", rf"\1:{ROOT}", commands)
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", commands],
        cwd=folder,
        env={**os.environ, "PATH": path, "PYTHONPATH": f".:{ROOT}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_user_follows_the_tutorial(flown):
    folder, said = flown
    assert re.search(r"Last policy: +-\d", said)
    assert "exported" in said
    start, *_, end = re.findall(r"step +(\d+): position +(\S+), push +(\S+)", said)
    assert (start[0], start[1], end[0]) == ("0", "1.000", "100")
    model = SAC.load(folder / "logs/sac/Docking-v0_1/Docking-v0.zip")
    push, _ = model.predict(np.array([1.0, -0.5], np.float32), deterministic=True)
    assert float(start[2]) == pytest.approx(push[0], abs=1e-3)


@pytest.mark.skipif(
    any(shutil.which(name) is None for name in ("arm-none-eabi-gcc", "qemu-system-arm", "make")),
    reason="needs arm-none-eabi-gcc, qemu-system-arm and make",
)
def test_the_policy_of_the_tutorial_acts_alike_on_both_boards(flown):
    install, *steps = tutorial_steps()[-1].splitlines(keepends=True)
    assert install.startswith("sudo apt-get install")
    said = shell("export PYTHONPATH=.\n" + "".join(steps), flown[0])
    assert said.count("1000 actions differ from model.predict by") == 2


def test_the_methods_by_network_of_the_documents_train():
    code, *_ = python_blocks("docs/methods.md")
    names: dict[str, object] = {}
    exec(compile(code, "docs/methods.md", "exec"), names)
    model: Any = names["model"]
    with pytest.warns(UserWarning, match=r"'rigl' had no mask update.*500th gradient step"):
        model.learn(110, callback=names["callback"])  # ten gradient steps


def test_the_method_of_the_documents_trains():
    _, code, *others = python_blocks("docs/methods.md")
    for other in others:
        exec(compile(other, "docs/methods.md", "exec"), {})
    assert code.count("update_interval=500") == 1
    code = code.replace("update_interval=500", "update_interval=50")
    names: dict[str, object] = {"__name__": "docs"}
    try:
        exec(compile(code, "docs/methods.md", "exec"), names)
        model = make("SAC")
        before = [layer.mask() for layer in model.policy.sparse.layers]
        model.learn(200, callback=names["callback"])
        assert any(
            (layer.mask() != mask).any()
            for layer, mask in zip(model.policy.sparse.layers, before, strict=True)
        )
        assert_masked(model)
    finally:
        registry._METHODS.pop("preferential", None)


def test_the_sparse_model_of_the_documents_trains():
    (code,) = python_blocks("docs/compute.md")
    assert "1024, 1024" in code
    small = code.replace("1024, 1024", "24, 24").replace("HalfCheetah-v5", "Pendulum-v1")
    names = {"SAC": SAC, "SparsePolicy": SparsePolicy}
    exec(compile(small, "docs/compute.md", "exec"), names)
    assert all(layer.is_sparse for layer in names["model"].policy.sparse.layers)
    names["model"].learn(110)


def test_the_fused_model_of_the_documents_trains(capsys):
    code, *_ = python_blocks("docs/gradient_steps.md")
    small = code.replace("1_000_000", "150").replace("HalfCheetah-v5", "Pendulum-v1")
    assert small.count("150") == small.count("Pendulum") == 1
    exec(compile(small, "docs/gradient_steps.md", "exec"), {})
    assert capsys.readouterr().out.splitlines()[0] == "None"


class TorchCQL(DQN):
    """What the algorithm of the documents computes, with tensors."""

    def train(self, gradient_steps, batch_size=100):
        self._update_learning_rate(self.policy.optimizer)
        for _ in range(gradient_steps):
            data = self.replay_buffer.sample(batch_size)
            with th.no_grad():
                next_q = self.q_net_target(data.next_observations).max(dim=1, keepdim=True).values
                wanted = data.rewards + (1 - data.dones) * self.gamma * next_q
            q = self.q_net(data.observations)
            taken = q.gather(1, data.actions)
            penalty = (q.logsumexp(dim=1, keepdim=True) - taken).mean()
            loss = th.nn.functional.smooth_l1_loss(taken, wanted) + 0.5 * penalty
            self.policy.optimizer.zero_grad()
            loss.backward()
            th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
            self.policy.optimizer.step()


def test_the_algorithm_of_the_documents_learns_what_it_says():
    code = python_blocks("docs/gradient_steps.md")[1]
    names: dict[str, Any] = {}
    exec(compile(code, "docs/gradient_steps.md", "exec"), names)
    own, expected, plain = (
        make(cls, "CartPole-v1", **arguments_of(DQN)).learn(50)
        for cls in (names["CQL"], TorchCQL, DQN)
    )
    assert own.why_not_fused() is None
    weights = expected.policy.state_dict()
    for key, value in own.policy.state_dict().items():
        th.testing.assert_close(value, weights[key], rtol=1e-4, atol=1e-6)
    layer = "q_net.q_net.0.weight"
    assert not th.allclose(plain.policy.state_dict()[layer], weights[layer], rtol=1e-4)


def test_the_registered_algorithm_of_the_documents_is_counted():
    code = python_blocks("docs/gradient_steps.md")[2]
    names: dict[str, Any] = {"__name__": "docs"}
    try:
        exec(compile(code, "docs/gradient_steps.md", "exec"), names)
        model = make(names["MySAC"], "Pendulum-v1", **arguments_of(names["MySAC"]))
        assert isinstance(model.policy, names["MySACPolicy"])
        assert flops(model).step() == flops(make("SAC")).step()
        assert [(p.forward, p.backward) for p in names["passes"](model)][0] == (2, 1)
    finally:
        algorithms_registry._registered.pop("MySAC", None)


def test_the_measures_of_the_documents_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code = "".join(python_blocks("docs/analysis.md"))
    changes = {
        "1_000_000": "150",
        "10_000": "50",
        "1_000": "50",
        '"HalfCheetah-v5"': '"Pendulum-v1"',
        "np.zeros(17)": "np.zeros(3)",
        "feature_std(model, clean)": "feature_std(model, clean, 200)",
        "[0, 0.1, 0.2, 0.5, 1]": "[0, 1]",
        "n_envs=10": "n_envs=5",
        "seeds=(0, 1)": "n_episodes=5",
    }
    for old, new in changes.items():
        assert old in code
        code = code.replace(old, new)
    exec(compile(code, "docs/analysis.md", "exec"), {})
    said = capsys.readouterr().out
    assert "gradient step of SAC" in said
    assert "DormantShare" in said
    assert {path.name for path in (tmp_path / "run").iterdir()} == {
        "snr.csv",
        "plasticity.csv",
        "plasticity.masks.npz",
    }


def test_the_example_of_simba_trains_a_sparse_network():
    (code,) = python_blocks("docs/simba.md")
    names: dict[str, Any] = {}
    exec(compile(code, "docs/simba.md", "exec"), names)
    assert names["model"].why_not_fused() is None
    assert_masked(names["model"])


@pytest.mark.parametrize("path", ["README.md", *(f"docs/{p.name}" for p in ROOT.glob("docs/*.md"))])
def test_links_lead_somewhere(path):
    text = (ROOT / path).read_text()
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        if not target.startswith("http"):
            assert ((ROOT / path).parent / target).exists(), target


def test_the_readme_has_the_command_that_ci_runs():
    text = (ROOT / "README.md").read_text()
    (command,) = re.findall(r"<!-- tests -->\n```sh\n(.*)\n```", text)
    assert "-c constraints.txt" in command
    assert "pytest" in command


class Enough(Exception):
    pass


def train_commands() -> list[str]:
    """Every ``sb3-sparse train`` that the documents show to start a run."""
    lines = [line for line in shell_lines() if line.startswith("sb3-sparse train")]
    return [line for line in lines if "--resume" not in line and "mine.yml" not in line]


def shell_lines() -> list[str]:
    paths = ("README.md", "docs/index.md", "docs/configs.md", "docs/tuning.md")
    text = "".join((ROOT / path).read_text() for path in paths)
    blocks = "".join(re.findall(r"```sh\n(.*?)```", text, re.DOTALL)).replace("\\\n", " ")
    return blocks.splitlines()


@pytest.mark.parametrize("command", train_commands())
def test_the_train_commands_of_the_documents_have_settings(command, monkeypatch):
    runs = []

    def note(run, *args, **kwargs):
        runs.append(run)
        raise Enough

    monkeypatch.setattr("sb3_sparse.zoo.training.train", note)
    words = shlex.split(command, comments=True)[1:]
    with pytest.raises(Enough):
        cli.app(words, standalone_mode=False)
    (run,) = runs
    assert run.settings()["n_timesteps"] > 0


def tune_commands() -> list[str]:
    lines = [line for line in shell_lines() if line.startswith("sb3-sparse tune")]
    return [line for line in lines if "tune report" not in line]


@pytest.mark.parametrize("command", tune_commands())
def test_the_tune_commands_of_the_documents_have_a_study(command, monkeypatch, tmp_path):
    asked = []

    def note(run, space, **options):
        asked.append((run, space, options))
        raise Enough

    monkeypatch.setattr("sb3_sparse.tuning.tune", note)
    words = shlex.split(command, comments=True)[1:]
    with pytest.raises(Enough):
        cli.app(words, standalone_mode=False)
    ((run, space, options),) = asked
    chosen = [options[name] for name in ("sampler", "pruner")]
    definition = define(run, space, options["seeds"], *chosen, tmp_path)
    assert definition.trials(options["trials"]) > 0


def test_the_spaces_of_the_documents_are_spaces(tmp_path):
    text = (ROOT / "docs/tuning.md").read_text()
    for kind, suffix in (("yaml", "yml"), ("python", "py")):
        code = re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL)[0]
        path = tmp_path / f"mine.{suffix}"
        path.write_text(code)
        check_space(space_of(str(path), RunSpec()), RunSpec())


def test_the_script_of_the_tuning_document_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code = python_blocks("docs/tuning.md")[1]
    small = code.replace("n_timesteps=50_000", "n_timesteps=2000").replace(
        "n_trials=10", "n_trials=1"
    )
    small = small.replace("seeds=2", "seeds=1")
    small = small.replace("[100, 1000]", "[100]").replace("[0.0, 1e-6]", "[0.0]")
    assert len(code) - len(small) == 2 + 1 + 6 + 6
    exec(compile(small, "docs/tuning.md", "exec"), {})
    assert "best.yml" in capsys.readouterr().out


def test_the_config_of_the_documents_trains(tmp_path):
    (config,) = re.findall(r"```yaml\n(.*?)```", (ROOT / "docs/configs.md").read_text(), re.DOTALL)
    path = tmp_path / "mine.yml"
    path.write_text(config)
    outcome = train(RunSpec(conf_file=str(path), n_timesteps=200), tmp_path)
    assert outcome.finished
    assert outcome.model.learning_rate(1.0) == 1e-3
    assert abs(outcome.model.policy.sparse.sparsity - 0.95) < 0.001


def export_commands() -> list[str]:
    text = (ROOT / "README.md").read_text() + (ROOT / "docs/deploy.md").read_text()
    lines = "".join(re.findall(r"```sh\n(.*?)```", text, re.DOTALL)).splitlines()
    return [line for line in lines if line.startswith(("sb3-sparse export", "sb3-sparse compress"))]


RUNS = ("HalfCheetah-v5_1", "Hopper-v5_1", "Pendulum-v1_1")


@pytest.mark.parametrize("command", export_commands())
def test_the_export_and_compress_commands_of_the_documents_are_understood(command, monkeypatch):
    asked = []

    def note(path, **options):
        asked.append((path, options))
        raise Enough

    monkeypatch.setattr("sb3_sparse.zoo.saved.SavedModel.find", note)
    with pytest.raises(Enough):
        cli.app(shlex.split(command, comments=True)[1:], standalone_mode=False)
    ((path, _),) = asked
    assert path.name in (*RUNS, "model.zip", "sbx_sac.zip")


def test_the_programs_of_the_deployment_document_run(tmp_path):
    text = (ROOT / "docs/deploy.md").read_text()
    (main,) = re.findall(r"```c\n(.*?)```", text, re.DOTALL)
    (command,) = [line for line in text.splitlines() if line.startswith("cc ")]
    (loader,) = python_blocks("docs/deploy.md")
    model = make("SAC")
    export_policy(model, tmp_path / "policy", "c")
    export_policy(model, tmp_path / "policy", "numpy")
    (tmp_path / "main.c").write_text(main)
    said = subprocess.run(command, shell=True, cwd=tmp_path, capture_output=True, check=True).stdout
    action, _ = model.predict(np.zeros(3, np.float32), deterministic=True)
    assert [float(line) for line in said.split()] == pytest.approx([action[0]] * 3, abs=1e-5)
    code = f"observation = [0.0, 0.0, 0.0]\n{loader}\nprint(action[0])"
    python = [sys.executable, "-c", code]
    said = subprocess.run(python, cwd=tmp_path, capture_output=True, check=True).stdout
    assert float(said) == pytest.approx(action[0], abs=1e-5)
