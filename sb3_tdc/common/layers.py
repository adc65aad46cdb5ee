"""Layers that several networks have in parallel."""

import math

import torch as th
from torch import nn


class StackedLinear(nn.Module):
    """
    One ``nn.Linear`` per network, as a single batched matrix product. Initialised like ``nn.Linear``.

    :param n_networks: C, networks in parallel
    :param in_features: features in
    :param out_features: features out
    """

    def __init__(self, n_networks: int, in_features: int, out_features: int):
        super().__init__()
        self.weight = nn.Parameter(th.empty(n_networks, in_features, out_features))
        self.bias = nn.Parameter(th.empty(n_networks, 1, out_features))
        bound = 1 / math.sqrt(in_features) if in_features > 0 else 0.0
        nn.init.uniform_(self.weight, -bound, bound)
        nn.init.uniform_(self.bias, -bound, bound)

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """Return (C, B, out) of (B, in), shared by the networks, or of (C, B, in)."""
        return th.baddbmm(self.bias, inputs.expand(len(self.weight), -1, -1), self.weight)

    def forward_first(self, inputs: th.Tensor) -> th.Tensor:
        """Return (B, out) of (B, in), through the first network alone."""
        return th.addmm(self.bias[0], inputs, self.weight[0])

    def extra_repr(self) -> str:
        n_networks, in_features, out_features = self.weight.shape
        return f"n_networks={n_networks}, in_features={in_features}, out_features={out_features}"
