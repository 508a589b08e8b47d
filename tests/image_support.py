"""Modules on images twice: with dense masked convolutions, and with sparse ones in chains."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional

from sb3_sparse.engine.convolution import SparseConv2d
from sb3_sparse.engine.images import ImageChain
from sb3_sparse.engine.native import library
from sb3_sparse.engine.residual import Residual
from sb3_sparse.engine.sequential import ChainedSequential, chain_up
from sb3_sparse.engine.structure import Structure

TOLERANCE = 1e-5
KINDS = ["some", "full", "no output", "no input", "empty"]
"""Masks: what is missing entirely."""
KINKS: dict[type[nn.Module], tuple[float, ...]] = {
    nn.ReLU: (0.0,),
    nn.ELU: (0.0,),
    nn.CELU: (0.0,),
    nn.SELU: (0.0,),
    nn.LeakyReLU: (0.0,),
    nn.ReLU6: (0.0, 6.0),
    nn.Hardtanh: (-0.5, 0.75),
}
"""Where slopes jump; the tests give Hardtanh these bounds."""


def random_mask(shape: tuple[int, ...], kind: str, random: np.random.Generator) -> np.ndarray:
    mask = random.random(shape) < 0.4
    if kind == "full":
        mask[:] = True
    if kind == "no output":
        mask[random.integers(shape[0])] = False
    if kind == "no input":
        mask[:, random.integers(shape[1])] = False
    if kind == "empty":
        mask[:] = False
    return mask


def twins(
    *modules: nn.Module, seed: int = 0, kind: str = "some", whole: bool = False
) -> tuple[nn.Sequential, nn.Sequential]:
    """The modules as they are but for masks, and a copy with sparse convolutions.

    Convolutions with an attribute ``stays`` stay dense in both.

    :param kind: of the masks
    :param whole: whether weights and biases are whole numbers
    """
    random, draws = np.random.default_rng(seed), th.Generator().manual_seed(seed)
    dense = nn.Sequential(*modules)
    for layer in convolutions(dense):
        shape = tuple(layer.weight.shape)
        layer.mask = th.from_numpy(random_mask(shape, kind, random))
        with th.no_grad():
            for parameter in layer.parameters():
                if whole:
                    numbers = th.randint(0, 2, parameter.shape, generator=draws)
                    parameter.copy_(2 * numbers - 1)
                else:
                    parameter.copy_(th.randn(parameter.shape, generator=draws))
            if not whole:
                layer.weight.div_(max(1, float(layer.mask.sum()) / shape[0]) ** 0.5)
            layer.weight.mul_(layer.mask)
    sparse = copy.deepcopy(dense)
    for layer in convolutions(sparse):
        if not hasattr(layer, "stays"):
            matrix = (layer.out_channels, layer.weight[0].numel())
            structure = Structure.of_mask(layer.mask.numpy(), matrix)
            SparseConv2d.convert(layer, structure, is_target=False)
    chain_up(sparse)
    return dense, sparse


def convolutions(network: nn.Module) -> Iterator[nn.Conv2d]:
    return (module for module in network.modules() if isinstance(module, nn.Conv2d))


def chains(network: ChainedSequential) -> list[int]:
    """Steps of each chain of a network that has been called."""
    return [len(step.steps) for step, *_ in network._split.steps if isinstance(step, ImageChain)]


def close(ours: th.Tensor | None, theirs: th.Tensor | None, usual: float = 1e-2) -> None:
    """Equal to 1e-5 of the largest, or of what is usual where terms may cancel out."""
    assert (ours is None) == (theirs is None)
    if ours is None or theirs is None:
        return
    assert ours.shape == theirs.shape
    scale = max(float(theirs.detach().abs().max()), usual) if theirs.numel() else 1.0
    np.testing.assert_allclose(ours.detach(), theirs.detach(), rtol=0, atol=TOLERANCE * scale)


def active(layer: nn.Conv2d, dense: th.Tensor | None) -> th.Tensor | None:
    """What a dense weight's gradient is on active connections; a sparse layer's has their shape."""
    return dense if dense is None or hasattr(layer, "stays") else dense[layer.mask]


def compare(
    dense: nn.Sequential, sparse: nn.Sequential, x: th.Tensor, seed: int = 0, whole: bool = False
) -> None:
    """The same results and gradients of everything, with a graph and without one."""
    draws = th.Generator().manual_seed(seed)
    ours, theirs = x.clone().requires_grad_(), x.clone().requires_grad_()
    y, expected = sparse(ours), dense(theirs)
    close(y, expected)
    with th.no_grad():
        close(sparse(x), y)
        for row in range(min(2, len(x))):
            close(sparse(x[row : row + 1]), y[row : row + 1])
    grad = th.randn(expected.shape, generator=draws)
    grad = grad.round() if whole else grad
    squares: dict[nn.Module, tuple[th.Tensor, th.Tensor]] = {}

    def note(layer: nn.Conv2d, inputs: tuple[th.Tensor], output: th.Tensor) -> None:
        x = inputs[0].detach().square()
        output.register_hook(lambda grad: squares.update({layer: (x, grad.square())}))

    hooks = [layer.register_forward_hook(note) for layer in convolutions(dense)]
    dense(theirs).backward(grad)
    for hook in hooks:
        hook.remove()
    y.backward(grad)
    close(ours.grad, theirs.grad)
    for layer, twin in zip(convolutions(dense), convolutions(sparse), strict=True):
        # A sum of terms of random signs has the size of their root sum of squares.
        x2, g2 = squares[layer]
        shape, window = layer.weight.shape, (layer.stride, layer.padding)
        usual = float(nn.grad.conv2d_weight(x2, shape, g2, *window).sqrt().max())
        close(twin.weight.grad, active(layer, layer.weight.grad), usual)
        if layer.bias is not None:
            close(twin.bias.grad, layer.bias.grad, float(g2.sum((0, 2, 3)).sqrt().max()))


def margin(network: nn.Sequential, x: th.Tensor) -> float:
    """How near activations come to a kink, and poolings to a tie, relative to their inputs.

    What rounding does not decide must be further away than rounding reaches.
    """
    found = [1.0]

    def look(module: nn.Module, inputs: tuple[th.Tensor]) -> None:
        x = inputs[0].detach()
        scale = float(x.abs().max()) + 1e-9 if x.numel() else 1.0
        if isinstance(module, nn.MaxPool2d):
            kernel, padding = module.kernel_size, module.padding
            pair = (padding, padding) if isinstance(padding, int) else padding
            x = functional.pad(x, (pair[1], pair[1], pair[0], pair[0]), value=-1e9)
            windows = functional.unfold(x.flatten(0, 1)[:, None], kernel, stride=module.stride)
            if windows.shape[1] > 1 and windows.numel():
                best, second = windows.topk(2, dim=1).values.unbind(1)
                found.append(float((best - second).min()) / scale)
        for kink in KINKS.get(type(module), ()):
            if x.numel():
                found.append(float((x - kink).abs().min()) / scale)

    hooks = [module.register_forward_pre_hook(look) for module in network.modules()]
    with th.no_grad():
        network(x)
    for hook in hooks:
        hook.remove()
    return min(found)


def convolution(inputs: int = 2, outputs: int = 2, **kwargs) -> nn.Conv2d:
    """One that keeps the size."""
    return nn.Conv2d(inputs, outputs, 3, padding=1, **kwargs)


def whole(*shape: int, seed: int = 0) -> th.Tensor:
    return th.randint(-3, 4, shape, generator=th.Generator().manual_seed(seed)).float()


def impala() -> list[nn.Module]:
    """A stack of the Impala ResNet and a part of the next, small."""
    blocks = [
        Residual(nn.ReLU(), convolution(3, 3), nn.ReLU(), convolution(3, 3)) for _ in range(2)
    ]
    return [
        convolution(2, 3),
        nn.MaxPool2d(3, 2, 1),
        *blocks,
        nn.Conv2d(3, 2, (3, 2), (2, 1), (1, 0)),
        nn.Tanh(),
    ]


def gradients(network: nn.Module) -> list[th.Tensor]:
    """Copies of the gradients of all parameters."""
    return [parameter.grad.clone() for parameter in network.parameters()]


def inner(network: nn.Sequential) -> nn.Sequential:
    """The modules of the first residual block of a network of :func:`impala`."""
    return next(network[2].children())


@contextmanager
def using(instructions: str) -> Iterator[None]:
    """Compute with an instruction set for a while."""
    before = library.in_use()
    library.use(instructions)
    try:
        yield
    finally:
        library.use(before)
