"""Layers that evaluate several networks in parallel, and the mode of all layers of a network."""

import math
from collections.abc import Iterable

import torch as th
from torch import nn


class StackedLinear(nn.Module):
    """
    One ``nn.Linear`` per network, computed as a single batched matrix product. Initialised like ``nn.Linear``.

    :param n_networks: C, the number of networks
    :param in_features: number of input features of each network
    :param out_features: number of output features of each network
    """

    def __init__(self, n_networks: int, in_features: int, out_features: int):
        super().__init__()
        self.weight = nn.Parameter(th.empty(n_networks, in_features, out_features))
        self.bias = nn.Parameter(th.empty(n_networks, 1, out_features))
        bound = 1 / math.sqrt(in_features) if in_features > 0 else 0.0
        nn.init.uniform_(self.weight, -bound, bound)
        nn.init.uniform_(self.bias, -bound, bound)

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """Return the outputs (C, B, out) for inputs (B, in), which all networks share, or (C, B, in)."""
        return th.baddbmm(self.bias, inputs.expand(len(self.weight), -1, -1), self.weight)

    def forward_first(self, inputs: th.Tensor) -> th.Tensor:
        """Return the outputs (B, out) of the first network for inputs (B, in)."""
        return th.addmm(self.bias[0], inputs, self.weight[0])

    def extra_repr(self) -> str:
        n_networks, in_features, out_features = self.weight.shape
        return f"n_networks={n_networks}, in_features={in_features}, out_features={out_features}"


def are_in_mode(networks: Iterable[nn.Module], training: bool) -> bool:
    """Return whether networks and all their modules are in training mode, or all in evaluation mode."""
    modules: list[nn.Module | None] = list(networks)
    for module in modules:  # a loop, because ``modules()`` takes several times as long
        if module is not None:
            if module.training != training:
                return False
            modules.extend(module._modules.values())
    return True
