"""Adam and Polyak averaging, each in one call for all parameters of a network."""

from typing import Any

import torch as th
from torch import nn

from sb3_tdc.tdc.fused.scalar import Scalar


class AdamStep:
    """
    Adam steps of a network, on the state of its own optimizer, and Polyak steps of its target network.

    The gradients are preallocated; :meth:`show_gradients` makes them the ``grad`` of the parameters.

    :param network: a network with a plain Adam as its ``optimizer``
    :param target: a network of the same structure
    """

    def __init__(self, network: Any, target: nn.Module):
        self.group = network.optimizer.param_groups[0]
        self.parameters: list[nn.Parameter] = list(self.group["params"])
        self.values, self.targets = ([p.detach() for p in n.parameters()] for n in (network, target))
        self.gradients = [th.zeros_like(value) for value in self.values]
        self.steps = self.values[0].new_zeros(len(self.values))
        self.learning_rate = Scalar(self.values[0].new_empty(()))  # a tensor, so that a CUDA graph reads it
        states = [network.optimizer.state[parameter] for parameter in self.parameters]
        for state, value, step in zip(states, self.values, self.steps, strict=True):
            if state:
                step.copy_(state["step"])
            else:
                state.update(exp_avg=th.zeros_like(value), exp_avg_sq=th.zeros_like(value))
            state["step"] = step  # a view, so that one addition increments all of them
        means, squares = ([state[name] for state in states] for name in ("exp_avg", "exp_avg_sq"))
        self.tensors: Any = self.values, self.gradients, means, squares, [], list(self.steps)

    def read_learning_rate(self) -> None:
        """Read the optimizer's learning rate for the next steps."""
        self.learning_rate.set(self.group["lr"])

    def step(self) -> None:
        """Take one step of Adam along ``gradients``, as ``optimizer.step()`` would, at ``learning_rate``."""
        self.steps.add_(1)
        th._fused_adam_(
            *self.tensors,
            lr=self.learning_rate.tensor,
            beta1=self.group["betas"][0],
            beta2=self.group["betas"][1],
            weight_decay=0.0,
            eps=self.group["eps"],
            amsgrad=False,
            maximize=False,
        )

    def show_gradients(self) -> None:
        """Make each parameter's ``grad`` its preallocated gradient, where it is None or another tensor."""
        for parameter, gradient in zip(self.parameters, self.gradients, strict=True):
            if parameter.grad is not gradient:
                parameter.grad = gradient

    def update_targets(self, tau: float) -> None:
        """Move the targets towards the parameters (Eq. 16)."""
        th._foreach_lerp_(self.targets, self.values, tau)
