"""
Forward and hand-derived backward passes of ReLU networks, on preallocated buffers.

Shapes: C critics, B transitions, A action dimensions.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch as th

from sb3_tdc.tdc.fused import passes
from sb3_tdc.tdc.fused.passes import Passes


class Layer:
    """
    A linear layer, of one network or of C stacked ones, as (in, out) views of its parameters (or of their gradients).

    :param weight: (in, out) or (C, in, out)
    :param bias: (1, out) or (C, 1, out)
    """

    def __init__(self, weight: th.Tensor, bias: th.Tensor):
        self.weight, self.bias, self.transposed = weight, bias, weight.mT
        self.affine: Any = th.baddbmm if weight.ndim == 3 else th.addmm
        self.matmul: Any = th.bmm if weight.ndim == 3 else th.mm

    def first(self) -> "Layer":
        """Return the layer of the first critic alone."""
        return Layer(self.weight[0], self.bias[0])

    def forward(self, inputs: th.Tensor, output: th.Tensor) -> Callable[[], Any]:
        """Return a function that computes the output."""
        return partial(self.affine, self.bias, inputs, self.weight, out=output)


def make_layers(parameters: list[th.Tensor]) -> list[Layer]:
    """
    Return the layers of a network.

    :param parameters: weights and biases in turn, of ``nn.Linear`` (out, in) or ``StackedLinear`` (C, in, out)
    """
    return [
        Layer(*((w, b) if w.ndim == 3 else (w.mT, b.unsqueeze(0))))
        for w, b in zip(parameters[::2], parameters[1::2], strict=True)
    ]


class Mlp:
    """
    Forward and backward passes of linear layers with ReLU between them.

    Before a backward pass, the caller writes the gradient of the loss at the output of the last layer (before its
    ReLU, if it has one) into ``grad_outputs[-1]``, and its sum over transitions into the gradient of that layer's bias.

    :param layers: layers of the network
    :param inputs: (B, in), filled before each pass
    :param gradients: buffers for the gradients of the parameters; None to compute none
    :param activate_output: whether there is a ReLU after the last layer too
    :param outputs: buffers for the outputs of the layers
    :param grad_outputs: buffers for the gradients of the loss at these outputs; those of finished passes may be reused,
        which saves cache
    """

    def __init__(
        self,
        layers: list[Layer],
        inputs: th.Tensor,
        gradients: Sequence[Layer] | None = None,
        activate_output: bool = False,
        outputs: list[th.Tensor] | None = None,
        grad_outputs: list[th.Tensor] | None = None,
    ):
        stacked = layers[0].weight.shape[:-2]
        if outputs is None:
            outputs = [inputs.new_empty(*stacked, len(inputs), layer.bias.shape[-1]) for layer in layers]
        self.outputs = outputs
        self.grad_outputs = [th.empty_like(output) for output in outputs] if grad_outputs is None else grad_outputs
        all_inputs = [inputs.expand(*stacked, -1, -1), *outputs[:-1]]
        # Bind every product and pass to its tensors once, so that none is looked up or viewed again
        self.products = [
            layer.forward(layer_inputs, output)
            for layer, layer_inputs, output in zip(layers, all_inputs, outputs, strict=True)
        ]
        self.relus: list[Callable[[], Any] | None] = [output.relu_ for output in outputs]
        if not activate_output:
            self.relus[-1] = None
        self.weight_products: list[Callable[[], Any]] = [
            partial(gradient.matmul, layer_inputs.mT, grad_output, out=gradient.weight)
            for gradient, layer_inputs, grad_output in zip(
                gradients or [], all_inputs, self.grad_outputs, strict=bool(gradients)
            )
        ]
        self.grad_input_products: list[Callable[[], Any]] = [
            partial(layer.matmul, grad_output, layer.transposed, out=grad_input)
            for layer, grad_output, grad_input in zip(
                layers[1:], self.grad_outputs[1:], self.grad_outputs, strict=False
            )
        ]
        self.relu_passes: list[Callable[[], Any]] = [
            partial(passes.threshold_backward, grad_output, output, 0, grad_input=grad_output)
            for grad_output, output in zip(self.grad_outputs, outputs, strict=True)
        ]
        self.bias_sums: list[Callable[[], Any]] = [
            partial(th.sum, grad_output, dim=-2, keepdim=True, out=gradient.bias)
            for grad_output, gradient in zip(self.grad_outputs, gradients or [], strict=bool(gradients))
        ]

    def forward(self) -> th.Tensor:
        """Compute and return the output, (B, out) or (C, B, out), which the next pass overwrites."""
        for product, relu in zip(self.products, self.relus, strict=True):
            product()
            if relu is not None:
                relu()
        return self.outputs[-1]

    def backward(self) -> th.Tensor:
        """Compute all gradients, and return that of the loss at the output of the first layer, before its ReLU."""
        for i in reversed(range(len(self.grad_outputs))):
            if self.weight_products:
                self.weight_products[i]()
            if i > 0:
                self.grad_input_products[i - 1]()
                self.backward_relu(i - 1)
        return self.grad_outputs[0]

    def backward_relu(self, i: int) -> None:
        """Backpropagate the gradient at the output of layer ``i`` through its ReLU, and compute that of its bias."""
        self.relu_passes[i]()
        if self.bias_sums:
            self.bias_sums[i]()


class DeterministicHead:
    """
    TD3's actor: a = tanh(f(s)) (Eq. 20).

    :param layers: layers of the network
    :param observations: (B, D), filled before each pass
    :param actions: (B, A), where the mean actions are written
    :param bind: binds the passes to their buffers
    :param gradients: see :class:`Mlp`
    """

    def __init__(
        self,
        layers: list[Layer],
        observations: th.Tensor,
        actions: th.Tensor,
        bind: Passes,
        gradients: Sequence[Layer] | None = None,
    ):
        self.network, self.actions = Mlp(layers, observations, gradients), actions
        output, self.grad_actions = self.network.outputs[-1], self.network.grad_outputs[-1]
        self.squash = bind(passes.squash, output, actions)
        if gradients is not None:
            self.tanh_backward = bind(passes.tanh_backward, self.grad_actions, output, gradients[-1].bias)

    def act(self) -> th.Tensor:
        """Compute the mean actions, and return them in ``actions``."""
        self.network.forward()
        self.squash()
        return self.actions

    def backward(self) -> None:
        """Compute the gradients from ``grad_actions``, (B, A), the gradient of the loss at the actions."""
        self.tanh_backward()
        self.network.backward()


class TanhGaussianHead:
    """
    SAC's actor: a = tanh(u), u = m(s) + σ(s)·ε (Eq. 21).

    log π = −½ε² − log σ − log(1 − a² + e) + const at fixed ε, so that ∂log π/∂u = 2a(1 − a²)/(1 − a² + e), ∂u/∂m = 1,
    ∂u/∂log σ = σε, and the term −log σ adds −1. Here e is ``TANH_EPSILON``.

    :param layers: layers of the network; the last two are m and log σ
    :param observations: (B, D), filled before each pass
    :param actions: (B, A), where the samples are written
    :param bind: binds the passes to their buffers
    :param gradients: see :class:`Mlp`
    :param ent_coef: (1,), α, for the backward pass
    """

    def __init__(
        self,
        layers: list[Layer],
        observations: th.Tensor,
        actions: th.Tensor,
        bind: Passes,
        gradients: Sequence[Layer] | None = None,
        ent_coef: th.Tensor | None = None,
    ):
        *hidden, mean_layer, log_std_layer = layers
        self.network = Mlp(hidden, observations, gradients and gradients[:-2], activate_output=True)
        self.actions = actions
        features = self.network.outputs[-1]
        mean, raw_log_std, self.noise, scaled_noise, grad_log_std, self.grad_actions = (
            th.empty_like(actions, memory_format=th.contiguous_format) for _ in range(6)
        )
        self.heads = [mean_layer.forward(features, mean), log_std_layer.forward(features, raw_log_std)]
        self.sample = bind(passes.sample_actions, mean, raw_log_std, self.noise, scaled_noise, actions)
        if gradients is None:
            return
        self.log_probs = actions.new_empty(len(actions))
        self.log_density = bind(passes.log_density, mean, raw_log_std, self.noise, self.log_probs)
        at_mean, at_log_std = gradients[-2:]
        read = self.grad_actions, ent_coef, mean, raw_log_std, scaled_noise
        written = grad_log_std, at_mean.bias, at_log_std.bias
        self.sample_backward = bind(passes.tanh_gaussian_backward, *read, *written)
        grad_output = self.network.grad_outputs[-1]
        self.head_products: list[Callable[[], Any]] = [
            partial(th.mm, features.mT, self.grad_actions, out=at_mean.weight),
            partial(th.mm, features.mT, grad_log_std, out=at_log_std.weight),
            partial(th.mm, self.grad_actions, mean_layer.transposed, out=grad_output),
            partial(th.addmm, grad_output, grad_log_std, log_std_layer.transposed, out=grad_output),
        ]

    def act(self) -> th.Tensor:
        """Sample actions from the policy, and return them in ``actions``."""
        self.network.forward()
        for product in self.heads:
            product()
        self.noise.normal_()
        self.sample()
        return self.actions

    def log_prob(self) -> th.Tensor:
        """Return the log density of the last sample, (B,)."""
        self.log_density()
        return self.log_probs

    def backward(self) -> None:
        """Compute the gradients from ``grad_actions``, (B, A), that at the actions of the loss without entropy."""
        self.sample_backward()
        for product in self.head_products:
            product()
        self.network.backward_relu(-1)
        self.network.backward()
