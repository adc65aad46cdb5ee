"""
The update of ``tdc.py`` on static buffers, for plain ReLU networks: no autograd, no allocation, flat parameters.

The weights of the policy become views of one flat tensor per optimizer, as do their gradients and Adam's moments, so
that an optimizer step and a Polyak step are one call each. What is computed is ``TDC._update_critics`` and
``TDC._update_actor`` to float32 rounding, on the same random numbers; the backward passes are derived by hand.

Shapes: C critics, B transitions, N quantiles, D observation, A action.
"""

import math
from typing import TYPE_CHECKING, NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN
from torch import nn

from sb3_tdc.tdc.policies import StackedLinear
from sb3_tdc.tdc.quantiles import quantile_huber_row_gradients, quantile_midpoints

if TYPE_CHECKING:
    from sb3_tdc.tdc.tdc import TDC

_LOG_SQRT_2_PI = 0.5 * math.log(2 * math.pi)
_TANH_EPSILON = 1e-6  # in the density of the tanh-Gaussian, as in SB3


def obstacles(model: "TDC") -> list[str]:
    """:return: what stands in the way of the fused update, in words; empty where it applies"""
    policy, found = model.policy, []
    if not (isinstance(model.observation_space, spaces.Box) and len(model.observation_space.shape) == 1):
        found.append("the observations are not flat vectors")
    if policy.features_extractor_class is not FlattenExtractor:
        found.append(f"the features extractor is a {policy.features_extractor_class.__name__}")
    if policy.activation_fn is not nn.ReLU:
        found.append(f"the activation is {policy.activation_fn.__name__}, not ReLU")
    plain_adam = {"fused", "eps", "betas", "weight_decay"}
    if policy.optimizer_class is not th.optim.Adam or not set(policy.optimizer_kwargs) <= plain_adam:
        found.append(f"the optimizer is {policy.optimizer_class.__name__} with {policy.optimizer_kwargs}")
    if type(policy.actor).__module__ not in ("stable_baselines3.td3.policies", "stable_baselines3.sac.policies"):
        found.append(f"the actor is a {type(policy.actor).__qualname__} of {type(policy.actor).__module__}")
    if model.device.type != "cpu":
        found.append(f"the device is {model.device}")
    return found


class _FlatAdam:
    """
    Parameters of an Adam optimizer, moved into one flat tensor; so are their gradients, moments and targets.

    The parameters, the optimizer's state and the targets stay what they were for everyone else: views.
    """

    def __init__(self, optimizer: th.optim.Optimizer, targets: list[nn.Parameter] | None = None):
        self.group = optimizer.param_groups[0]
        parameters = self.group["params"]
        self.value = self._flatten(parameters)
        self.gradient = th.zeros_like(self.value)
        self.mean, self.square = th.zeros_like(self.value), th.zeros_like(self.value)
        self.step_count = th.zeros((), dtype=th.float32)
        for p, gradient, mean, square in zip(
            parameters, *(self._views(flat, parameters) for flat in (self.gradient, self.mean, self.square)), strict=True
        ):
            state = optimizer.state[p]
            if state:
                mean.copy_(state["exp_avg"])
                square.copy_(state["exp_avg_sq"])
                self.step_count.copy_(state["step"])
            optimizer.state[p] = {"step": self.step_count, "exp_avg": mean, "exp_avg_sq": square}
            p.grad = gradient
        self.target = self._flatten(targets) if targets is not None else None

    @staticmethod
    def _views(flat: th.Tensor, parameters: list[nn.Parameter]) -> list[th.Tensor]:
        return [part.view(p.shape) for part, p in zip(flat.split([p.numel() for p in parameters]), parameters, strict=True)]
