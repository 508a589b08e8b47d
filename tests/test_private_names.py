"""Private names of other libraries: each is there, and read in the module that gathers them."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import pytest
import stable_baselines3
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import nn
from torch.fx.experimental.proxy_tensor import make_fx

from sb3_sparse.engine import internals as of_torch
from sb3_sparse.policies import internals as of_sb3

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "sb3_sparse"
GATHERED = {"engine/internals.py", "policies/internals.py", "tuning/internals.py"}
# Read from other objects elsewhere, because a subclass or a seam of the library is there.
ELSEWHERE = {
    "_asdict", "_replace",  # named tuples
    "_getframe",  # sys
    "_predict",  # which SB3 has every policy define
    # rl_zoo3
    "_hyperparams", "_preprocess_hyperparams", "_preprocess_action_noise", "_save_config",
}  # fmt: skip


@pytest.mark.parametrize(
    ("module", "name"), [(of_torch, "torch"), (of_sb3, "stable_baselines3")], ids=["torch", "sb3"]
)
def test_the_names_were_checked_against_the_pinned_version(module, name):
    pins = (ROOT / "constraints.txt").read_text().splitlines()
    (version,) = [pin.partition("==")[2] for pin in pins if pin.startswith(f"{name}==")]
    assert f"Checked against {name} {version}." in module.__doc__


MADE = {
    nn.Module: nn.Linear(1, 1),
    th.Tensor: th.zeros(1, requires_grad=True),
    th.optim.Optimizer: th.optim.Adam([th.zeros(1, requires_grad=True)]),
    th.distributions.Distribution: th.distributions.Distribution,
}


@pytest.mark.parametrize(
    ("kind", "name"),
    [(kind, name) for kind, names in of_torch.ATTRIBUTES.items() for name in names],
)
def test_torch_has_the_attributes_that_are_read(kind, name):
    assert hasattr(MADE[kind], name)


def test_whoever_watches_operations_is_seen():
    seen = []

    def function(x):
        seen.append(of_torch.watching())
        return x

    function(th.zeros(1))
    make_fx(function)(th.zeros(1))
    th.func.vmap(function)(th.zeros(1))
    th.func.grad(lambda x: function(x).sum())(th.zeros(1))
    th.jit.trace(function, th.zeros(1), check_trace=False)
    with th.autograd.forward_ad.dual_level():
        function(th.zeros(1))
    assert seen == [False, True, True, True, True, True]


def test_hooks_on_everything_are_seen():
    layer = nn.Linear(1, 1)
    optimizer = th.optim.SGD(layer.parameters())
    assert not of_torch.any_global_hook()
    assert not any(of_torch.module_hooks(vars(layer)))
    assert not any(of_torch.step_hooks(optimizer)[:2])
    layer.register_full_backward_hook(lambda *_: None)
    optimizer.register_step_post_hook(lambda *_: None)
    handle = nn.modules.module.register_module_forward_hook(lambda *_: None)
    try:
        assert of_torch.any_global_hook()
    finally:
        handle.remove()
    assert list(map(len, of_torch.module_hooks(vars(layer)))) == [0, 0, 1, 0]
    assert list(map(len, of_torch.step_hooks(optimizer)[:2])) == [0, 1]


def test_several_gradients_at_once_are_seen():
    seen = []
    x = th.zeros(2, requires_grad=True)
    y = x * 1
    y.register_hook(lambda grad: seen.append(of_torch.is_batched(grad)))
    y.sum().backward(retain_graph=True)
    th.autograd.grad(y, x, th.eye(2), is_grads_batched=True)
    assert seen == [False, True]


def test_whatever_refers_to_memory_is_counted():
    tensor, weight = th.zeros(4), th.ones(2, requires_grad=True)
    alone = of_torch.use_count(tensor)
    part = tensor[2:]
    assert of_torch.use_count(tensor) == of_torch.use_count(part) == alone + 1
    result = weight * part
    del part
    assert of_torch.use_count(tensor) == alone + 1  # the graph has saved it
    result.sum().backward()
    assert of_torch.use_count(tensor) == alone
    result = weight * tensor[:2]
    assert of_torch.use_count(tensor) == alone + 1
    del result
    assert of_torch.use_count(tensor) == alone
    array = tensor[2:].numpy()
    assert of_torch.use_count(tensor) > alone
    del array
    assert of_torch.use_count(tensor) == alone


def test_sb3_has_the_names_that_are_read():
    env = make_vec_env("CartPole-v1")
    model = stable_baselines3.PPO("MlpPolicy", env, n_steps=4, batch_size=4, device="cpu")
    for name in (*of_sb3.LAST_SEEN, *of_sb3.COUNTERS):
        assert hasattr(model, name)
    assert of_sb3.last_observations(model) == (None, None)
    assert not of_sb3.has_own_logger(model)
    model.learn(4)
    model.learn(8, reset_num_timesteps=False)
    assert of_sb3.planned_timesteps(model) == 12
    assert of_sb3.timesteps_since_start(model) == 8
    assert of_sb3.progress_remaining(model) == 0.0
    assert of_sb3.updates_done(model) == 3 * model.n_epochs
    observation, original = of_sb3.last_observations(model)
    assert observation.shape == (1, 4)
    assert original is None  # there is no VecNormalize
    assert len(of_sb3.samples(model.rollout_buffer, [0, 2]).actions) == 2
    model.set_logger(model.logger)
    assert of_sb3.has_own_logger(model)
    assert of_sb3.wrapped(gym.make("CartPole-v1")).num_envs == 1
    space = model.observation_space
    assert of_sb3.space_of(FlattenExtractor(space)) is space
    assert of_sb3.no_schedule(1.0) == 0.0


def foreign_names(path: Path) -> Iterator[str]:
    """Private names that a module imports from libraries, or reads from objects but its own."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and not (node.module or "").startswith("sb3_sparse"):
            yield from (alias.name for alias in node.names if alias.name.startswith("_"))
        if not isinstance(node, ast.Attribute) or not node.attr.startswith("_"):
            continue
        owner = node.value
        inherited = isinstance(owner, ast.Name) and owner.id in ("self", "cls")
        calls_super = isinstance(owner, ast.Call) and getattr(owner.func, "id", "") == "super"
        if not node.attr.startswith("__") and not inherited and not calls_super:
            yield node.attr


def own_names() -> set[str]:
    """Private names that the package itself gives to something."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found.add(node.name)
            if isinstance(node, ast.Attribute | ast.Name) and isinstance(node.ctx, ast.Store):
                found.add(node.attr if isinstance(node, ast.Attribute) else node.id)
    return found


def test_private_names_of_libraries_are_read_where_they_are_gathered():
    known = own_names() | ELSEWHERE | {n for names in of_torch.ATTRIBUTES.values() for n in names}
    strangers = {
        f"{path.relative_to(PACKAGE)}: {name}"
        for path in PACKAGE.rglob("*.py")
        if path.relative_to(PACKAGE).as_posix() not in GATHERED
        for name in foreign_names(path)
        if name not in known
    }
    assert strangers == set()


def test_the_checker_sees_a_private_name(tmp_path):
    path = tmp_path / "wrong.py"
    path.write_text("from torch import _x\nself._own = super()._own = model._last_obs\n")
    assert set(foreign_names(path)) == {"_x", "_last_obs"}
