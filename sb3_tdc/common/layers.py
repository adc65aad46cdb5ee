"""Layers that several networks have in parallel."""

import math

import torch as th
from torch import nn


class StackedLinear(nn.Module):
    """
    One ``nn.Linear`` per critic, as a single batched matrix product. Initialised like ``nn.Linear``.

    :param n_critics: C
    :param in_features: features in
    :param out_features: features out
    """

    def __init__(self, n_critics: int, in_features: int, out_features: int):
        super().__init__()
        self.weight = nn.Parameter(th.empty(n_critics, in_features, out_features))
        self.bias = nn.Parameter(th.empty(n_critics, 1, out_features))
        bound = 1 / math.sqrt(in_features) if in_features > 0 else 0.0
        nn.init.uniform_(self.weight, -bound, bound)
        nn.init.uniform_(self.bias, -bound, bound)

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """(B, in), shared by the critics, or (C, B, in) → (C, B, out)."""
        return th.baddbmm(self.bias, inputs.expand(len(self.weight), -1, -1), self.weight)

    def forward_first(self, inputs: th.Tensor) -> th.Tensor:
        """(B, in) → (B, out), through the first critic alone."""
        return th.addmm(self.bias[0], inputs, self.weight[0])

    def extra_repr(self) -> str:
        n_critics, in_features, out_features = self.weight.shape
        return f"n_critics={n_critics}, in_features={in_features}, out_features={out_features}"
