"""What the command line and imports leave alone: torch if nobody needs it, other libraries."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from sb3_sparse.experiments.blocks import SCALES, planned_runs, study_names
from sb3_sparse.experiments.spec import Study

HEAVY = ["torch", "stable_baselines3", "sb3_contrib", "rl_zoo3", "optuna", "matplotlib", "pandas"]


def run(code: str, *args: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code, *args]
    return subprocess.run(command, capture_output=True, text=True, check=False)


COMMAND = f"""
import sys
sys.argv[0] = "/somewhere/bin/sb3-sparse"
from sb3_sparse.cli import main
try:
    main()
finally:
    print("loaded:", *sorted(set({HEAVY}) & set(sys.modules)))
"""


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["--help"], "Sparse training inside"),
        (["train", "--help"], "--sparsity"),
        (["tune", "--help"], "--trials"),
        (["study", "list"], "classic_control"),
        (["trian"], "No such command"),
        (["train", "--alog", "sac"], "No such option"),
        (["train", "--algo", "dqnn"], "did you mean 'dqn'?"),
        (["train", "--env", "CartPool-v1"], "did you mean 'CartPole-v1'?"),
        (["train", "--method", "riggle"], "no config is shipped for method 'riggle'"),
        (["tune", "--algo", "sacc"], "did you mean 'sac'?"),
        (["study", "run", "classic_contol"], "did you mean 'classic_control'?"),
    ],
)
def test_help_lists_and_mistyped_names_need_no_torch(args, said):
    done = run(COMMAND, *args)
    assert said in done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout.splitlines()[-1].strip() == "loaded:"


def test_a_package_that_is_imported_before_sb3_registers_its_policies_all_the_same():
    done = run(
        "import sb3_sparse\n"
        "from stable_baselines3 import SAC\n"
        "SAC('SparsePolicy', 'Pendulum-v1', policy_kwargs=dict(sparsity=0.9))\n"
        "print(sorted(set(sb3_sparse.__all__) - set(dir(sb3_sparse))))\n"
        "[getattr(sb3_sparse, name) for name in sb3_sparse.__all__]\n"
    )
    assert done.stdout.strip() == "[]", done.stderr


EVERYTHING = """
import json, logging, os, pkgutil, sys, warnings
from importlib import import_module
import gymnasium, matplotlib, numpy, optuna, pandas, rl_zoo3.exp_manager, rl_zoo3.train, sb3_contrib
import stable_baselines3, torch, ale_py, onnx, plotly.io, ray, ruamel.yaml, tensorboard, yaml
import rliable.library, scipy.stats, moviepy, onnxruntime, psycopg, typer, rich
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER
from torch.optim import optimizer

def state():
    return {
        "warnings": [repr(one) for one in warnings.filters],
        "showwarning": repr(warnings.showwarning),
        "formatwarning": repr(warnings.formatwarning),
        "optuna": optuna.logging.get_verbosity(),
        "matplotlib": [matplotlib.get_backend(), repr(dict(matplotlib.rcParams))],
        "threads": torch.get_num_threads(),
        "dtype": str(torch.get_default_dtype()),
        "random": [torch.get_rng_state().sum().item(), repr(numpy.random.get_state()[1][:9])],
        "hooks": [len(optimizer._global_optimizer_pre_hooks),
                  len(optimizer._global_optimizer_post_hooks)],
        "environment": dict(os.environ),
        "logging": [logging.root.level, repr(logging.root.handlers)],
        "rl_zoo3": [repr(ExperimentManager.objective), repr(sorted(HYPERPARAMS_SAMPLER.items()))],
        "excepthook": repr(sys.excepthook),
        "yaml": sorted(map(str, yaml.SafeLoader.yaml_constructors)),
        "cwd": sorted(os.listdir()),
        "pandas": pandas.get_option("display.max_rows"),
    }

before = state()
import sb3_sparse
for module in pkgutil.walk_packages(sb3_sparse.__path__, "sb3_sparse."):
    patches = module.name == "sb3_sparse.rl_zoo_optimize"  # as its name says
    if not patches and not module.name.endswith((".__main__", ".kernels")):
        import_module(module.name)
after = state()
print(json.dumps([key for key in before if before[key] != after[key]]))
"""


def test_importing_everything_changes_nothing_of_other_libraries():
    done = run(EVERYTHING)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == []


@pytest.mark.parametrize("name", study_names())
def test_the_list_of_studies_counts_the_runs_that_there_are(name):
    planned = planned_runs(name)
    for scale in SCALES:
        study = Study.read(name, scale)
        assert planned[scale] == len(study.cells) + len(study.merged), scale
