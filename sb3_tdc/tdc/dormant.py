"""Dormant units: units that hardly respond to any input any more (Sokar et al., ICML 2023)."""

from collections.abc import Iterable

import torch as th
from torch import nn

# A unit is dormant if its mean absolute activation is at most this share of its layer's mean
THRESHOLD = 0.025


@th.no_grad()
def relu_activations(layers: Iterable[nn.Module], inputs: th.Tensor) -> tuple[list[th.Tensor], th.Tensor]:
    """
    Pass inputs through layers and collect the outputs of the ReLUs.

    :param inputs: (B, in)
    :return: the output of every ReLU, (..., B, units), and the last output
    """
    activations = []
    for layer in layers:
        inputs = layer(inputs)
        if isinstance(layer, nn.ReLU):
            activations.append(inputs)
    return activations, inputs


def dormant_share(activations: Iterable[th.Tensor], threshold: float = THRESHOLD) -> th.Tensor:
    """
    Return the share of dormant units in some hidden layers.

    :param activations: activations of each layer, (..., B, units); leading axes index parallel networks
    :return: scalar, between 0 and 1; in a layer that is 0 everywhere, all units count as dormant
    """
    dormant = []
    for layer in activations:
        mean = layer.abs().mean(dim=-2)  # (..., units)
        dormant.append((mean <= threshold * mean.mean(dim=-1, keepdim=True)).flatten())
    return th.cat(dormant).float().mean()
