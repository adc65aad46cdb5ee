"""Layers that evaluate several networks in parallel."""

import math

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
