"""What the command line and imports leave alone: torch if nobody needs it, other libraries."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from pkgutil import iter_modules

import pytest
from forks import run_in_forks

HEAVY = ["torch", "stable_baselines3", "sb3_contrib", "rl_zoo3", "optuna", "matplotlib", "pandas"]


def run(code: str, *args: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code, *args]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


IMPORT = """
import sys
sys.argv[0] = "/somewhere/bin/sb3-sparse"
from sb3_sparse.cli import main
"""
COMMAND = f"""
try:
    main()
finally:
    print("loaded:", *sorted(set({HEAVY}) & set(sys.modules)))
"""
LIGHT = {
    ("--help",): "Sparse training inside",
    ("--version",): f"sb3-sparse {version('sb3-sparse')}",
    ("train", "--help"): "--sparsity",
    ("tune", "--help"): "--trials",
    ("study", "list"): "classic_control",
    ("trian",): "No such command",
    ("train", "--alog", "sac"): "No such option",
    ("train", "--algo", "dqnn"): "did you mean 'dqn'?",
    ("train", "--env", "CartPool-v1"): "did you mean 'CartPole-v1'?",
    ("train", "--method", "riggle"): "no config is shipped for method 'riggle'",
    ("tune", "--algo", "sacc"): "did you mean 'sac'?",
    ("tune", "--space", "papers"): "did you mean 'paper'?",
    ("tune", "--sampler", "gird"): "did you mean 'grid'?",
    ("tune", "--launcher", "slurm"): "unknown launcher 'slurm'; allowed are local, ray",
    ("export", "model.zip", "--to", "onxn"): "did you mean 'onnx'?",
    ("study", "run", "classic_contol"): "did you mean 'classic_control'?",
    ("study", "status", "classic_contol"): "did you mean 'classic_control'?",
    ("study", "report", "snr", "--scale", "smal"): "did you mean 'small'?",
}


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """What each command ends with, by its arguments."""
    codes = [f"sys.argv[1:] = {args!r}\n{COMMAND}" for args in LIGHT]
    forks = run_in_forks(IMPORT, codes, tmp_path_factory.mktemp("light"))
    return dict(zip(LIGHT, forks, strict=True))


@pytest.mark.parametrize("args", LIGHT, ids=" ".join)
def test_help_lists_and_mistyped_names_need_no_torch(args, answers):
    done = answers[args]
    assert LIGHT[args] in done.out + done.err
    assert "Traceback" not in done.err
    assert done.out.splitlines()[-1].strip() == "loaded:"


def test_a_package_that_is_imported_before_sb3_registers_its_policies_all_the_same():
    done = run(
        "import sb3_sparse\n"
        "from stable_baselines3 import SAC\n"
        "SAC('SparsePolicy', 'Pendulum-v1', policy_kwargs=dict(sparsity=0.9))\n"
        "print(sorted(set(sb3_sparse.__all__) - set(dir(sb3_sparse))))\n"
        "[getattr(sb3_sparse, name) for name in sb3_sparse.__all__]\n"
    )
    assert done.stdout.strip() == "[]", done.stderr


def test_packages_of_environments_find_the_policies_registered_in_a_command(tmp_path):
    (tmp_path / "with_opponent.py").write_text(
        "import gymnasium\n"
        "import sb3_sparse\n"
        "from stable_baselines3 import PPO\n"
        "OPPONENT = PPO('SparsePolicy', 'CartPole-v1', policy_kwargs=dict(sparsity=0.9))\n"
        "gymnasium.register('Against-v0', 'gymnasium.envs.classic_control:CartPoleEnv')\n"
    )
    env = ["--env", "with_opponent:Against-v0", "--method", "riggle"]
    done = run(
        f"import sys\nsys.path.insert(0, '')\n{IMPORT}{COMMAND}", "train", *env, cwd=tmp_path
    )
    assert "no config is shipped for method 'riggle'" in done.stderr


EVERYTHING = """
import json, logging, os, pkgutil, signal, sys, types, warnings
from importlib import import_module
from importlib.metadata import version
import gymnasium, matplotlib, numpy, optuna, pandas, rl_zoo3.enjoy, rl_zoo3.train, sb3_contrib
import stable_baselines3, torch, ale_py, mujoco, onnx, ray, ruamel.yaml, tensorboard
import rliable.library, scipy.stats, moviepy, yaml, onnxruntime, psycopg, sqlalchemy, typer, rich
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER
from torch.optim import optimizer

warnings.simplefilter("ignore")  # some of what is looked at is deprecated
LIBRARIES = {
    "gymnasium", "logging", "matplotlib", "mujoco", "numpy", "optuna", "os", "pandas", "rich",
    "rl_zoo3", "sb3_contrib", "scipy", "signal", "stable_baselines3", "sys", "torch", "typer",
    "warnings", "yaml",
}

def attributes():
    "Functions, classes, methods and containers of other libraries' modules and classes."
    found = {}
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] not in LIBRARIES or not isinstance(module, types.ModuleType):
            continue
        for key, value in list(vars(module).items()):
            found[name, key] = value
            if isinstance(value, type) and value.__module__.split(".")[0] in LIBRARIES:
                found.update({(name, key, own): one for own, one in vars(value).items()})
    kinds = (type, types.FunctionType, property, classmethod, staticmethod, dict, list, set)
    return {key: value for key, value in found.items() if isinstance(value, kinds)}

def state():
    return {
        "warnings": [repr(one) for one in warnings.filters],
        "optuna": optuna.logging.get_verbosity(),
        "matplotlib": [matplotlib.get_backend(), repr(dict(matplotlib.rcParams))],
        "torch": [torch.get_num_threads(), torch.is_grad_enabled(), str(torch.get_default_dtype()),
                  torch.backends.mkldnn.enabled, torch.backends.cudnn.benchmark],
        "denormals": (torch.tensor([1e-40]) * 1.0).item(),
        "random": [torch.get_rng_state().sum().item(), repr(numpy.random.get_state()[1][:9])],
        "hooks": [len(optimizer._global_optimizer_pre_hooks),
                  len(optimizer._global_optimizer_post_hooks)],
        "numpy": [repr(numpy.geterr()), repr(numpy.get_printoptions())],
        "environment": dict(os.environ),
        "logging": [logging.root.level, repr(logging.root.handlers)],
        "signals": [repr(signal.getsignal(number)) for number in range(1, 30)],
        "imports": [repr(sys.meta_path), repr(sys.path_hooks), list(sys.path)],
        "rl_zoo3": repr(sorted(HYPERPARAMS_SAMPLER.items())),
        "gymnasium": sorted(gymnasium.registry),
        "mujoco": repr(mujoco.get_mju_user_warning()),
        "yaml": sorted(map(str, yaml.SafeLoader.yaml_constructors)),
        "cwd": sorted(os.listdir()),
    }

state()  # which looks at what libraries load as they are asked
before, objects = state(), attributes()

def changes():
    after, now = state(), attributes()
    return [
        [key for key in before if before[key] != after[key]],
        [".".join(key) for key, value in objects.items() if now.get(key) is not value],
    ]

import sb3_sparse
PATCHES = "sb3_sparse.rl_zoo_optimize"  # as its name says
for module in pkgutil.walk_packages(sb3_sparse.__path__, "sb3_sparse."):
    if not module.name.endswith((".__main__", PATCHES)) and ".native." not in module.name:
        import_module(module.name)
ours = changes()
import_module(PATCHES)
print(json.dumps([ours, changes(), len(objects)]))
"""


def test_only_the_patching_module_changes_anything_of_other_libraries(tmp_path):
    done = run(EVERYTHING, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    ours, of_patches, count = json.loads(done.stdout.splitlines()[-1])
    assert ours == [[], []]
    assert count > 10_000
    changed, replaced = of_patches  # which shows that changes are seen
    assert changed == ["rl_zoo3"]
    assert {name.rpartition("Experiment")[2] for name in replaced} == {"Manager.objective"}


@pytest.mark.parametrize("package", ["", ".algorithms", ".studies", ".export", ".tuning"])
def test_names_that_are_imported_as_needed_are_no_modules(package):
    module = import_module(f"sb3_sparse{package}")
    modules = {one.name for one in iter_modules(module.__path__)}
    for name in module.__all__:
        assert name not in modules
        assert name in dir(module)
        getattr(module, name)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        module.nothing  # noqa: B018
