"""Adam and Polyak averaging on flat tensors."""

from typing import Any

import torch as th
from torch import nn

from sb3_tdc.tdc.fused.applicability import is_plain_adam
from sb3_tdc.tdc.fused.scalar import Scalar


class FlatAdam:
    """
    The parameters of an Adam optimizer, and their targets, as one flat tensor each.

    For everyone else the parameters, the optimizer's state and the targets stay what they were, now as views.
    """

    def __init__(self, network: Any, target: nn.Module):
        self.network, self.optimizer = network, network.optimizer
        self.parameters: list[nn.Parameter] = self.optimizer.param_groups[0]["params"]
        self.targets = list(target.parameters())
        self.value, self.target = self._flatten(self.parameters), self._flatten(self.targets)
        self.gradient, self.mean, self.square = (th.zeros_like(self.value) for _ in range(3))
        self.steps = th.zeros(len(self.parameters), device=self.value.device)
        self.learning_rate = Scalar(th.empty((), device=self.value.device))  # a tensor, so that a CUDA graph reads it
        moments = (self.views(flat) for flat in (self.mean, self.square))
        for parameter, step, mean, square in zip(self.parameters, self.steps, *moments, strict=True):
            state = self.optimizer.state[parameter]
            if state:
                step.copy_(state["step"])
                mean.copy_(state["exp_avg"])
                square.copy_(state["exp_avg_sq"])
            self.optimizer.state[parameter] = {"step": step, "exp_avg": mean, "exp_avg_sq": square}
        self.tensors: Any = [self.value], [self.gradient], [self.mean], [self.square], [], [self.steps[0]]
        self.owned = [
            (p, p.data_ptr(), target, target.data_ptr(), self.optimizer.state[p]["exp_avg"])
            for p, target in zip(self.parameters, self.targets, strict=True)
        ]

    def views(self, flat: th.Tensor) -> list[th.Tensor]:
        """:return: the parts of a flat tensor, in the shapes of the parameters"""
        parts = flat.split([parameter.numel() for parameter in self.parameters])
        return [part.view_as(parameter) for part, parameter in zip(parts, self.parameters, strict=True)]

    def _flatten(self, parameters: list[nn.Parameter]) -> th.Tensor:
        flat = th.cat([parameter.detach().ravel() for parameter in parameters])
        for parameter, view in zip(parameters, self.views(flat), strict=True):
            parameter.data = view
        return flat

    def owns_parameters(self) -> bool:
        """:return: whether network, targets and optimizer still use these tensors, and all of them learn as they did"""
        optimizer = self.optimizer
        if self.network.optimizer is not optimizer or not is_plain_adam(optimizer):
            return False
        state = optimizer.state
        for p, value, target, target_value, mean in self.owned:
            if p.data_ptr() != value or target.data_ptr() != target_value or not p.requires_grad:
                return False
            if p not in state or state[p].get("exp_avg") is not mean:
                return False
        return True

    def read_learning_rate(self) -> None:
        """Take the learning rate of the optimizer for the next steps."""
        self.learning_rate.set(self.optimizer.param_groups[0]["lr"])

    def step(self) -> None:
        """One step of Adam along ``gradient``, as ``optimizer.step()`` would do it at ``learning_rate``."""
        group = self.optimizer.param_groups[0]
        self.steps.add_(1)
        th._fused_adam_(
            *self.tensors,
            lr=self.learning_rate.tensor,
            beta1=group["betas"][0],
            beta2=group["betas"][1],
            weight_decay=0.0,
            eps=group["eps"],
            amsgrad=False,
            maximize=False,
        )

    def update_targets(self, tau: float) -> None:
        """Eq. 16."""
        self.target.lerp_(self.value, tau)
