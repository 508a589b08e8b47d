"""SimBa: residual blocks that keep wide networks trainable."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torch import nn

from sb3_sparse.engine.residual import Residual
from sb3_sparse.errors import ConfigError

EXPANSION = 4
"""Hidden units of a block for each of its inputs."""
EPSILON = 1e-6
"""Added to the variance by LayerNorm, as in JAX, in which SimBa and SBX are written."""


class SimbaBlock(Residual):
    """Computes ``x + linear(relu(linear(norm(x))))`` with four times as many hidden units.

    Example::

        import torch as th
        from sb3_sparse.networks import SimbaBlock

        SimbaBlock(128)(th.zeros(1, 128)).shape  # (1, 128)

    :param width: number of inputs and of outputs
    :param activation_fn: makes the activation between the linear layers

    Source: arXiv:2410.09754, section 4.
    """

    def __init__(self, width: int, activation_fn: Callable[[], nn.Module] = nn.ReLU) -> None:
        super().__init__(
            nn.LayerNorm(width, eps=EPSILON),
            nn.Linear(width, EXPANSION * width),
            activation_fn(),
            nn.Linear(EXPANSION * width, width),
        )


def simba(
    inputs: int, net_arch: Sequence[int], activation_fn: Callable[[], nn.Module] = nn.ReLU
) -> nn.Sequential:
    """Build a SimBa network without its head: a linear layer, blocks, and a LayerNorm.

    Example::

        from sb3_sparse.networks import simba

        network = simba(17, [256, 256])  # two blocks
        sum(parameter.numel() for parameter in network.parameters())  # 1,057,280

    :param inputs: number of inputs
    :param net_arch: one entry a block, all equal: the width of the network
    :param activation_fn: makes the activation within a block
    :raises ConfigError: if there is no block, or if widths differ

    Source: arXiv:2410.09754, section 4; ``net_arch`` as in SBX.
    """
    widths = list(net_arch)
    if not widths or len(set(widths)) > 1:
        raise ConfigError(
            "net_arch of a SimBa network has one entry for each of its blocks, all of the same "
            f"width, since each block adds to its input, e.g. [256, 256]; got {widths}"
        )
    width = widths[0]
    network = nn.Sequential(
        nn.Linear(inputs, width),
        *(SimbaBlock(width, activation_fn) for _ in widths),
        nn.LayerNorm(width, eps=EPSILON),
    )
    initialise(network)
    return network


def initialise(network: nn.Module) -> None:
    """Draw weights as SimBa does: He normal in blocks, orthogonal elsewhere; biases are 0."""
    blocks = [module for module in network.modules() if isinstance(module, SimbaBlock)]
    within = {id(module) for block in blocks for module in block.modules()}
    for module in network.modules():
        if not isinstance(module, nn.Linear):
            continue
        if id(module) in within:
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
        else:
            nn.init.orthogonal_(module.weight)
        nn.init.zeros_(module.bias)
