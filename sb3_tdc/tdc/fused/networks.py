"""
Forward and hand-derived backward passes of ReLU networks, on buffers that are kept.

Shapes: C critics, B transitions, A action.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch as th
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN

_LOG_SQRT_2_PI = 0.5 * math.log(2 * math.pi)
_TANH_EPSILON = 1e-6  # in the density of the tanh-Gaussian, as in SB3


class Layer:
    """
    A linear layer, of one network or of C stacked ones, as (in, out) views of its parameters (or of their gradients).

    :param weight: (in, out) or (C, in, out)
    :param bias: (1, out) or (C, 1, out)
    :param bfloat16: whether its matrix products are taken of factors rounded to bfloat16
    """

    def __init__(self, weight: th.Tensor, bias: th.Tensor, bfloat16: bool = False):
        self.weight, self.bias, self.bfloat16 = weight, bias, bfloat16
        self.transposed = weight.mT
        self.affine: Any = th.baddbmm if weight.ndim == 3 else th.addmm
        self.matmul: Any = th.bmm if weight.ndim == 3 else th.mm
        if bfloat16:
            self.affine, self.matmul = _affine_bfloat16, _matmul_bfloat16

    def first(self) -> "Layer":
        """:return: the layer of the first critic alone"""
        return Layer(self.weight[0], self.bias[0], self.bfloat16)


def _affine_bfloat16(bias: th.Tensor, inputs: th.Tensor, weight: th.Tensor, *, out: th.Tensor) -> th.Tensor:
    return th.add(bias, th.matmul(inputs.bfloat16(), weight.bfloat16()), out=out)


def _matmul_bfloat16(a: th.Tensor, b: th.Tensor, *, out: th.Tensor) -> th.Tensor:
    return out.copy_(th.matmul(a.bfloat16(), b.bfloat16()))


def make_layers(parameters: list[th.Tensor], n_outputs: int = 1, bfloat16: bool = False) -> list[Layer]:
    """
    :param parameters: of ``nn.Linear`` (out, in) or of ``StackedLinear`` (C, in, out), weight and bias in turn
    :param n_outputs: how many of the layers, at the end, are outputs
    :param bfloat16: for the layers between the first and the outputs, where most of the arithmetic is
    """
    weights, biases = parameters[::2], parameters[1::2]
    rounded = range(1, len(weights) - n_outputs) if bfloat16 else ()
    return [
        Layer(*((w, b) if w.ndim == 3 else (w.mT, b.unsqueeze(0))), bfloat16=i in rounded)
        for i, (w, b) in enumerate(zip(weights, biases, strict=True))
    ]


class Mlp:
    """
    Forward and backward passes of linear layers with ReLU between them, on buffers that are kept.

    :param layers: of the network
    :param inputs: (B, in), filled before each pass
    :param gradients: where a backward pass writes those of the parameters; None to go without
    :param activate_output: whether there is a ReLU behind the last layer too
    :param outputs: buffers for the outputs of the layers
    :param slopes: buffers for the slopes there; those of passes that are over by then keep the cache small
    """

    def __init__(
        self,
        layers: list[Layer],
        inputs: th.Tensor,
        gradients: Sequence[Layer | None] | None = None,
        activate_output: bool = False,
        outputs: list[th.Tensor] | None = None,
        slopes: list[th.Tensor] | None = None,
    ):
        stacked = layers[0].weight.shape[:-2]
        if outputs is None:
            outputs = [inputs.new_empty(*stacked, len(inputs), layer.bias.shape[-1]) for layer in layers]
        self.outputs = outputs
        self.slopes = [th.empty_like(output) for output in outputs] if slopes is None else slopes
        # Both passes with all their tensors, so that none is looked up or viewed again
        all_inputs = [inputs.expand(*stacked, -1, -1), *outputs[:-1]]
        activated = [True] * (len(layers) - 1) + [activate_output]
        self.forward_steps = list(zip(layers, all_inputs, outputs, activated, strict=True))
        slopes_below = [None, *self.slopes[: len(layers) - 1]]
        transposed = [layer_inputs.mT for layer_inputs in all_inputs]
        steps = zip(layers, gradients or [None] * len(layers), all_inputs, transposed, slopes_below, strict=True)
        self.backward_steps = list(steps)[::-1]

    def forward(self) -> th.Tensor:
        """:return: (B, out) or (C, B, out), overwritten by the next pass"""
        for layer, inputs, output, activated in self.forward_steps:
            layer.affine(layer.bias, inputs, layer.weight, out=output)
            if activated:
                output.relu_()
        return output

    def backward(self, slope: th.Tensor) -> th.Tensor:
        """
        :param slope: of the loss at the output of the last layer (before a ReLU); the buffers of the last pass count
        :return: the slope at the output of the first layer, before its ReLU
        """
        for layer, gradient, inputs, transposed_inputs, slope_below in self.backward_steps:
            if gradient is not None:
                gradient.matmul(transposed_inputs, slope, out=gradient.weight)
                th.sum(slope, dim=-2, keepdim=True, out=gradient.bias)
            if slope_below is not None:
                layer.matmul(slope, layer.transposed, out=slope_below)
                slope = relu_backward(slope_below, inputs, out=slope_below)
        return slope


_threshold_backward = th.ops.aten.threshold_backward.grad_input
_tanh_backward = th.ops.aten.tanh_backward.grad_input


def relu_backward(slope: th.Tensor, activation: th.Tensor, out: th.Tensor) -> th.Tensor:
    """:return: the slope where the activation is not 0, in ``out``"""
    return _threshold_backward(slope, activation, 0, grad_input=out)


class DeterministicHead:
    """
    TD3's actor: a = tanh(f(s)) (Eq. 20).

    :param layers: of the network
    :param observations: (B, D), filled before each pass
    :param actions: (B, A), where the mean actions are written
    :param gradients: see :class:`Mlp`
    """

    def __init__(
        self,
        layers: list[Layer],
        observations: th.Tensor,
        actions: th.Tensor,
        gradients: Sequence[Layer | None] | None = None,
    ):
        self.network, self.actions = Mlp(layers, observations, gradients), actions

    def act(self) -> th.Tensor:
        """:return: ``actions``"""
        return self.actions.copy_(self.network.forward().tanh_())

    def backward(self, action_slope: th.Tensor) -> None:
        """:param action_slope: (B, A), of the loss at the actions; overwritten"""
        self.network.backward(_tanh_backward(action_slope, self.network.outputs[-1], grad_input=action_slope))


class TanhGaussianHead:
    """
    SAC's actor: a = tanh(u), u = m(s) + σ(s)·ε (Eq. 21).

    :param layers: of the network; the last two are m and log σ
    :param observations: (B, D), filled before each pass
    :param actions: (B, A), where the samples are written
    :param gradients: see :class:`Mlp`
    """

    def __init__(
        self,
        layers: list[Layer],
        observations: th.Tensor,
        actions: th.Tensor,
        gradients: Sequence[Layer | None] | None = None,
    ):
        *hidden, self.mean_layer, self.log_std_layer = layers
        *hidden_gradients, self.mean_gradient, self.log_std_gradient = gradients or [None] * len(layers)
        self.network = Mlp(hidden, observations, hidden_gradients, activate_output=True)
        self.actions = actions
        self.hidden = self.network.outputs[-1]
        self.transposed_hidden = self.hidden.mT
        self.noise, self.sample, self.raw_log_std = (th.empty_like(actions) for _ in range(3))

    def act(self) -> th.Tensor:
        """:return: ``actions``, a sample of the policy"""
        self.network.forward()
        th.addmm(self.mean_layer.bias, self.hidden, self.mean_layer.weight, out=self.sample)
        th.addmm(self.log_std_layer.bias, self.hidden, self.log_std_layer.weight, out=self.raw_log_std)
        self.log_std = self.raw_log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)
        self.spread = self.log_std.exp().mul_(self.noise.normal_())
        return self.actions.copy_(self.sample.add_(self.spread).tanh_())

    def log_prob(self) -> th.Tensor:
        """:return: (B,), log density of the last sample"""
        self.squash = 1 - self.sample.square()
        log_density = self.noise.square().mul_(-0.5).sub_(self.log_std).sub_(_LOG_SQRT_2_PI)
        return log_density.sub_((self.squash + _TANH_EPSILON).log_()).sum(dim=1)

    def backward(self, action_slope: th.Tensor, ent_coef: th.Tensor) -> None:
        """
        The slope of mean(α·log π) is added here. log π = −½ε² − log σ − log(1 − a² + e) + const, at fixed ε, so that
        ∂log π/∂u = 2a(1 − a²)/(1 − a² + e), ∂u/∂m = 1, ∂u/∂log σ = σε, and log σ itself counts −1.

        :param action_slope: (B, A), of the loss without the entropy, at the actions
        :param ent_coef: (1,), α
        """
        coefficient = ent_coef / len(self.sample)
        ratio = (2 * coefficient) * self.sample / (self.squash + _TANH_EPSILON)
        mean_slope = (action_slope + ratio).mul_(self.squash)
        log_std_slope = (mean_slope * self.spread).sub_(coefficient)
        log_std_slope.mul_((self.raw_log_std >= LOG_STD_MIN) & (self.raw_log_std <= LOG_STD_MAX))
        hidden_slope = None
        for slope, layer, gradient in (
            (mean_slope, self.mean_layer, self.mean_gradient),
            (log_std_slope, self.log_std_layer, self.log_std_gradient),
        ):
            assert gradient is not None
            th.mm(self.transposed_hidden, slope, out=gradient.weight)
            th.sum(slope, dim=0, keepdim=True, out=gradient.bias)
            part = th.mm(slope, layer.transposed)
            hidden_slope = part if hidden_slope is None else hidden_slope.add_(part)
        assert hidden_slope is not None
        self.network.backward(relu_backward(hidden_slope, self.hidden, out=hidden_slope))
