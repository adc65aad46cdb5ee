"""
The passes over memory between the matrix products, on preallocated tensors: in PyTorch, for CUDA or without Numba.

Each function or class has a compiled twin with the same name and arguments in ``kernels.py``, which describes the
arguments. A class takes the tensors in its constructor, and the arguments after them when it is called.
"""

import math
from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Any

import torch as th

from sb3_tdc.tdc.policies import LOG_SQRT_2_PI, LOG_STD_MAX, LOG_STD_MIN, TANH_EPSILON
from sb3_tdc.tdc.quantiles import QuantileHuberGradient

# Keeps a gradient where an activation is above a threshold; with the threshold 0, the backward pass of a ReLU
threshold_backward = th.ops.aten.threshold_backward.grad_input
_tanh_backward = th.ops.aten.tanh_backward.grad_input


class Passes:
    """
    A function that binds passes to preallocated tensors.

    :param kernels: the module of compiled twins, or None
    """

    def __init__(self, kernels: ModuleType | None):
        self.kernels = kernels

    def __call__(self, function: Callable[..., Any], *tensors: th.Tensor | None) -> Callable[..., Any]:
        """
        Bind a pass, or its compiled twin if there is one.

        :param function: a function or class of this module
        :param tensors: its first arguments
        :return: a function of the remaining arguments
        """
        if self.kernels is None:
            return function(*tensors) if isinstance(function, type) else partial(function, *tensors)
        arrays = (None if tensor is None else tensor.numpy() for tensor in tensors)
        return partial(getattr(self.kernels, function.__name__), *arrays)


class quantile_huber_gradient:  # noqa: N801  # a pass with buffers
    def __init__(self, current: th.Tensor, target: th.Tensor, gradient: th.Tensor, bias_gradient: th.Tensor):
        self.compute, self.bias_gradient = QuantileHuberGradient(current, target, gradient), bias_gradient

    def __call__(self, kappa: float) -> None:
        th.sum(self.compute(kappa), dim=1, keepdim=True, out=self.bias_gradient)


class lcb_target:  # noqa: N801
    def __init__(
        self,
        next_quantiles: th.Tensor,
        rewards: th.Tensor,
        dones: th.Tensor,
        discounts: th.Tensor,
        lam: th.Tensor,
        mean: th.Tensor,
        std: th.Tensor,
        selected: th.Tensor,
        target: th.Tensor,
    ):
        self.next_quantiles, self.next_rows = next_quantiles, next_quantiles.view(-1, next_quantiles.shape[-1])
        self.rewards, self.dones, self.discounts, self.lam = rewards, dones, discounts, lam
        self.mean, self.std, self.selected, self.target = mean, std, selected, target
        self.mean_column = mean.unsqueeze(2)
        self.centred, self.score = th.empty_like(next_quantiles), th.empty_like(mean)
        self.row_numbers = th.arange(len(target), device=target.device)
        self.smallest, self.index = mean.new_empty(len(target)), th.empty_like(selected)
        self.factor, self.taken = th.empty_like(discounts), th.empty_like(target)

    def __call__(self) -> None:
        n_quantiles = self.target.shape[1]
        th.mean(self.next_quantiles, dim=2, out=self.mean)
        th.sub(self.next_quantiles, self.mean_column, out=self.centred)
        th.linalg.vector_norm(self.centred, dim=2, out=self.std)
        self.std.mul_(1 / math.sqrt(n_quantiles))  # Eq. 4
        th.addcmul(self.mean, self.lam, self.std, value=-1, out=self.score)
        # Eq. 5, the first of equal critics; argmin would give the same index in six times as long
        th.min(self.score, dim=0, out=(self.smallest, self.selected))
        th.add(self.row_numbers, self.selected, alpha=len(self.target), out=self.index)
        th.index_select(self.next_rows, 0, self.index, out=self.taken)  # Eq. 6
        th.addcmul(self.discounts, self.discounts, self.dones, value=-1, out=self.factor)
        th.addcmul(self.rewards, self.factor, self.taken, out=self.target)  # Eq. 7


def squash(outputs: th.Tensor, actions: th.Tensor) -> None:
    actions.copy_(outputs.tanh_())


def tanh_backward(grad_output: th.Tensor, activation: th.Tensor, bias_gradient: th.Tensor) -> None:
    th.sum(_tanh_backward(grad_output, activation, grad_input=grad_output), dim=0, keepdim=True, out=bias_gradient)


def smooth_actions(noise: th.Tensor, actions: th.Tensor, clip: float) -> None:
    actions.add_(noise.clamp_(-clip, clip)).clamp_(-1, 1)


def sample_actions(
    mean: th.Tensor, raw_log_std: th.Tensor, noise: th.Tensor, scaled_noise: th.Tensor, actions: th.Tensor
) -> None:
    th.mul(raw_log_std.clamp(LOG_STD_MIN, LOG_STD_MAX).exp_(), noise, out=scaled_noise)
    actions.copy_(mean.add_(scaled_noise).tanh_())


def log_density(sample: th.Tensor, raw_log_std: th.Tensor, noise: th.Tensor, log_prob: th.Tensor) -> None:
    density = noise.square().mul_(-0.5).sub_(raw_log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)).sub_(LOG_SQRT_2_PI)
    th.sum(density.sub_((1 - sample.square()).add_(TANH_EPSILON).log_()), dim=1, out=log_prob)


def tanh_gaussian_backward(
    grad_output: th.Tensor,
    ent_coef: th.Tensor,
    sample: th.Tensor,
    raw_log_std: th.Tensor,
    scaled_noise: th.Tensor,
    grad_log_std: th.Tensor,
    mean_bias_gradient: th.Tensor,
    log_std_bias_gradient: th.Tensor,
) -> None:
    coefficient, squeeze = ent_coef / len(grad_output), 1 - sample.square()
    grad_output.add_((2 * coefficient) * sample / (squeeze + TANH_EPSILON)).mul_(squeeze)
    th.sum(grad_output, dim=0, keepdim=True, out=mean_bias_gradient)
    th.mul(grad_output, scaled_noise, out=grad_log_std)
    grad_log_std.sub_(coefficient).mul_((raw_log_std >= LOG_STD_MIN) & (raw_log_std <= LOG_STD_MAX))
    th.sum(grad_log_std, dim=0, keepdim=True, out=log_std_bias_gradient)


def mean_value(
    hidden: th.Tensor, weight: th.Tensor, bias: th.Tensor, grad_hidden: th.Tensor, values: th.Tensor
) -> None:
    mean_weight = weight.mean(dim=1)
    th.addmv(bias.mean().expand(len(hidden)), hidden, mean_weight, out=values)
    threshold_backward((mean_weight / -len(hidden)).expand_as(hidden), hidden, 0, grad_input=grad_hidden)


def gather(
    rows: th.Tensor,
    batch: th.Tensor,
    drawn_next_observations: th.Tensor,
    next_observations: th.Tensor,
    dones: th.Tensor,
    timeouts: th.Tensor,
    indices: Any,
) -> None:
    indices = th.from_numpy(indices).to(rows.device, non_blocking=True)
    th.index_select(rows, 0, indices, out=batch)
    next_observations.copy_(drawn_next_observations)
    dones.addcmul_(dones, timeouts, value=-1)
