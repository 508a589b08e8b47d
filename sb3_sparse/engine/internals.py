"""Everything private to torch that this package relies on, so that a release breaks one file.

Checked against torch 2.13.0. ``tests/test_private_names.py`` fails when a name is gone, and when
another module reads a private name that is not listed here.
"""

from __future__ import annotations

from operator import itemgetter
from typing import Any, TypeVar

import torch as th
from torch import nn
from torch.autograd import forward_ad
from torch.nn.modules.module import _has_any_global_hook
from torch.optim import optimizer as torch_optimizer
from torch.utils import _pytree

Module = TypeVar("Module", bound=nn.Module)

MODULE_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
"""Attributes of a module that hold the hooks on its calls."""
STEP_HOOKS = ("_optimizer_step_pre_hooks", "_optimizer_step_post_hooks")
"""Attributes of an optimizer that hold the hooks on its steps."""
ATTRIBUTES: dict[type, tuple[str, ...]] = {
    nn.Module: (
        "_modules", "_parameters", "_buffers", "_apply", "_load_state_dict_post_hooks",
        "_save_to_state_dict", "_load_from_state_dict", *MODULE_HOOKS,
    ),
    th.Tensor: ("_version", "_backward_hooks", "_post_accumulate_grad_hooks"),
    th.optim.Optimizer: STEP_HOOKS,
    th.distributions.Distribution: ("_validate_args",),
}  # fmt: skip
"""Private attributes that are read where they are needed, by the class of torch that has them."""
WRAPPED = "_orig_mod"
"""Where ``torch.compile`` keeps the module that it has wrapped."""

any_global_hook: Any = _has_any_global_hook
"""Whether a hook is registered for all modules."""
pytree: Any = _pytree
"""Nested containers of tensors as flat lists."""
module_hooks: Any = itemgetter(*MODULE_HOOKS)
"""The hooks on the calls of a module, given its ``vars``."""


def watching() -> bool:
    """Whether single operations are observed: by tracing, dispatch modes or torch.func."""
    return (
        th._C._get_tracing_state() is not None
        or th._C._len_torch_dispatch_stack() > 0
        or th._C._functorch.peek_interpreter_stack() is not None
        or forward_ad._current_level >= 0
    )


def use_count(tensor: th.Tensor) -> int:
    """Count what refers to a tensor's memory: tensors, and graphs that saved one of them."""
    return int(th._C._storage_Use_Count(tensor.untyped_storage()._cdata))


def is_batched(gradient: th.Tensor) -> bool:
    """Whether a gradient is several at once, as in ``is_grads_batched`` and ``torch.func``."""
    kinds = th._C._functorch
    return bool(kinds.is_legacy_batchedtensor(gradient) or kinds.is_batchedtensor(gradient))


def step_hooks(optimizer: th.optim.Optimizer) -> list[dict[Any, Any]]:
    """Hooks before and after an optimizer's steps, then those on the steps of all optimizers."""
    everywhere: Any = torch_optimizer
    own = [getattr(optimizer, name) for name in STEP_HOOKS]
    return [*own, everywhere._global_optimizer_pre_hooks, everywhere._global_optimizer_post_hooks]


def become(module: nn.Module, cls: type[Module]) -> Module:
    """Change a module's class in place, as torch's parametrizations do.

    References to the module, its Parameters and their hooks stay valid, unlike those to a module
    that is replaced by a new one.
    """
    module.__class__ = cls
    assert isinstance(module, cls)
    return module


def replace_data(parameter: nn.Parameter, data: th.Tensor) -> None:
    """Give a Parameter other data, perhaps of another size; it stays the same object.

    While a graph of an earlier pass is alive, autograd keeps the node that accumulates the
    gradient, and with it the old size. Setting ``data`` of another type makes it drop the node, so
    an empty float64 tensor goes in between.
    """
    if parameter.shape == data.shape:
        with th.no_grad():
            parameter.copy_(data)
        return
    parameter.grad = None
    parameter.data = parameter.new_empty(0, dtype=th.float64)
    parameter.data = data
