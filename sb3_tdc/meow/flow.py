"""
The conditional normalising flow of MEOW: a Gaussian that depends on the state, shifted by couplings and squashed.

The couplings are implemented here. zuko, the maintained library of flows for PyTorch, has additive couplings
(``GeneralCouplingTransform`` with ``AdditiveTransform``), but its translation networks have no dropout, normalise after
the activation and without learnable scales, and with a single action its mask leaves nothing to shift. Its inverse and
backward pass took about twice as long as these, on one thread (``python -m benchmarks.flows``).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch as th
from torch import nn

# Actions at ±1 have no inverse under the tanh: densities clamp actions to this magnitude
MAX_ACTION = 1 - 1e-5


class Swish(nn.Module):
    """
    The activation x·σ(βx) with a learnable β for every unit, initially 1.

    :param shape: shape of β, one value for each unit
    """

    def __init__(self, *shape: int):
        super().__init__()
        self.beta = nn.Parameter(th.ones(*shape))

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        return inputs * th.sigmoid(self.beta * inputs)


def make_zeroed_mlp(in_features: int, net_arch: Sequence[int], out_features: int) -> nn.Sequential:
    """
    Build a network whose initial output is the same for every input: its weights, but not its biases, start at 0.

    :param in_features: number of inputs
    :param net_arch: units of the hidden layers
    :param out_features: number of outputs
    :return: the network
    """
    layers: list[nn.Module] = []
    for width in net_arch:
        layers += [nn.Linear(in_features, width), Swish(width)]
        in_features = width
    layers.append(nn.Linear(in_features, out_features))
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.zeros_(layer.weight)
    return nn.Sequential(*layers)


class AdditiveCoupling(nn.Module):
    """
    Shift of the elements outside a mask by a function of those inside it and of the state. Its log-determinant is 0.

    :param mask: (A,), 1 where an element stays as it is
    :param features_dim: number of features of the state
    :param net_arch: units of the hidden layers
    :param dropout: probability that a hidden unit is dropped in training mode
    """

    mask: th.Tensor

    def __init__(self, mask: th.Tensor, features_dim: int, net_arch: Sequence[int], dropout: float):
        super().__init__()
        self.register_buffer("mask", mask, persistent=False)
        layers: list[nn.Module] = []
        in_features = len(mask) + features_dim
        for width in net_arch:
            layers += [nn.Linear(in_features, width), nn.LayerNorm(width), Swish(width), nn.Dropout(dropout)]
            in_features = width
        self.translation = nn.Sequential(*layers, nn.Linear(in_features, len(mask)))
        for layer in self.translation:
            if isinstance(layer, nn.Linear):
                nn.init.orthogonal_(layer.weight)

    def shift(self, z: th.Tensor, features: th.Tensor) -> th.Tensor:
        """
        Return the shift that is added on the way to the action; computed before or after the addition, it is the same.

        :param z: (B, A)
        :param features: (B, D)
        :return: (B, A), 0 inside the mask
        """
        return (1 - self.mask) * self.translation(th.cat([self.mask * z, features], dim=1))


class Inverse(NamedTuple):
    """
    Latent variables of actions.

    z: (B, A)
    log_det: (B,), log |det ∂a/∂z| = Σ log(1 − a²)
    """

    z: th.Tensor
    log_det: th.Tensor


class ConditionalFlow(nn.Module):
    """
    A density of actions in (-1, 1) for every state, exact in both directions.

    z ~ N(0, diag σ(s)²) → additive couplings, two per block, with complementary masks → tanh. In training mode, dropout
    is active in the couplings, so ``inverse`` is the inverse of ``forward`` only in evaluation mode.

    :param features_dim: D, number of features of the state
    :param action_dim: A
    :param net_arch: units of the hidden layers of the couplings and of σ(s)
    :param n_blocks: blocks of two couplings
    :param dropout: probability that a hidden unit of a coupling is dropped in training mode
    :param log_std_min: lower limit of log σ(s)
    :param log_std_max: upper limit of log σ(s)
    """

    def __init__(
        self,
        features_dim: int,
        action_dim: int,
        net_arch: Sequence[int] = (64, 64),
        n_blocks: int = 2,
        dropout: float = 0.1,
        log_std_min: float = -5.0,
        log_std_max: float = -0.3,
    ):
        super().__init__()
        self.action_dim = action_dim
        self.log_std_min, self.log_std_max = log_std_min, log_std_max
        even = (th.arange(action_dim) + 1) % 2
        masks = [mask.float() for mask in (even, 1 - even)] * n_blocks
        self.couplings = nn.ModuleList(AdditiveCoupling(mask, features_dim, net_arch, dropout) for mask in masks)
        self.prior = make_zeroed_mlp(features_dim, net_arch, action_dim)

    def log_std(self, features: th.Tensor) -> th.Tensor:
        """
        Return log σ(s) of the latent Gaussian.

        :param features: (B, D)
        :return: (B, A), between its limits
        """
        half_range = (self.log_std_max - self.log_std_min) / 2
        return self.log_std_min + half_range * (th.tanh(self.prior(features)) + 1)

    def forward(self, z: th.Tensor, features: th.Tensor) -> th.Tensor:
        """
        Map latent variables to actions.

        :param z: (B, A)
        :param features: (B, D)
        :return: (B, A), in [-1, 1]
        """
        for coupling in self.couplings:
            z = z + coupling.shift(z, features)  # type: ignore[operator]
        return th.tanh(z)

    def inverse(self, actions: th.Tensor, features: th.Tensor) -> Inverse:
        """
        Map actions to latent variables; only this pass gives densities.

        :param actions: (B, A), in [-1, 1]
        :param features: (B, D)
        :return: latent variables, and the log-determinant of the map from them to the actions
        """
        actions = actions.clamp(-MAX_ACTION, MAX_ACTION)
        z = th.atanh(actions)
        for coupling in reversed(self.couplings):
            z = z - coupling.shift(z, features)  # type: ignore[operator]
        return Inverse(z, ((1 - actions) * (1 + actions)).log().sum(dim=1))

    def log_prob(self, actions: th.Tensor, features: th.Tensor) -> th.Tensor:
        """
        Return log π(a|s).

        :param actions: (B, A), in [-1, 1]
        :param features: (B, D)
        :return: (B,)
        """
        z, log_det = self.inverse(actions, features)
        log_std = self.log_std(features)
        log_prior = -0.5 * (z / log_std.exp()).square() - log_std - 0.5 * math.log(2 * math.pi)
        return log_prior.sum(dim=1) - log_det

    def sample(self, features: th.Tensor) -> th.Tensor:
        """
        Draw one action for every state.

        :param features: (B, D)
        :return: (B, A), in [-1, 1]
        """
        std = self.log_std(features).exp()
        return self(std * th.randn_like(std), features)

    def mode(self, features: th.Tensor) -> th.Tensor:
        """
        Return the actions of z = 0. Since couplings only shift, these have the highest density before the tanh.

        :param features: (B, D)
        :return: (B, A), in [-1, 1]
        """
        return self(features.new_zeros(len(features), self.action_dim), features)
