"""
The update of ``tdc.py`` on static buffers, for plain ReLU networks: no autograd, no allocation, flat parameters.

The weights of the policy become views of one flat tensor per optimizer, as do their gradients and Adam's moments, so
that an optimizer step and a Polyak step are one call each. What is computed is ``TDC.update_critics`` and
``TDC.update_actor`` to float32 rounding, on the same random numbers; the backward passes are derived by hand.

Shapes: C critics, B transitions, N quantiles, D observation, A action.
"""

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import FlattenExtractor, get_actor_critic_arch
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN
from stable_baselines3.sac.policies import Actor as TanhGaussianActor
from stable_baselines3.td3.policies import Actor as DeterministicActor
from torch import nn

from sb3_tdc.tdc.policies import QuantileCritic, TDCPolicy
from sb3_tdc.tdc.quantiles import QuantileHuberGradient, lcb_target

if TYPE_CHECKING:
    from sb3_tdc.tdc.tdc import TDC

_LOG_SQRT_2_PI = 0.5 * math.log(2 * math.pi)
_TANH_EPSILON = 1e-6  # in the density of the tanh-Gaussian, as in SB3


# What a subclass of TDC may override, and then expects to be called
_METHODS = ("train", "update_critics", "update_actor", "update_targets", "_sample_target_actions")
_CLASSES = (TDCPolicy, DeterministicActor, TanhGaussianActor, QuantileCritic)


def obstacles(model: "TDC") -> list[str]:
    """:return: what stands in the way of the fused update, in words; nothing where it applies"""
    from sb3_tdc.tdc.tdc import TDC

    policy, found = model.policy, []
    space = model.observation_space
    if not (isinstance(space, spaces.Box) and len(space.shape) == 1):
        found.append("the observations are not flat vectors")
    if policy.features_extractor_class is not FlattenExtractor:
        found.append(f"the features extractor is {policy.features_extractor_class.__name__}")
    if policy.activation_fn is not nn.ReLU:
        found.append(f"the activation is {policy.activation_fn.__name__}, not ReLU")
    if not all(len(arch) > 0 for arch in get_actor_critic_arch(policy.net_arch)):
        found.append("a network has no hidden layer")
    found += [f"{name} is overridden" for name in _METHODS if getattr(type(model), name) is not getattr(TDC, name)]
    networks = (policy, policy.actor, policy.actor_target, policy.critic, policy.critic_target)
    found += [f"{type(n).__qualname__} is a class of its own" for n in networks if type(n) not in _CLASSES]
    if _has_hooks(policy.modules()):
        found.append("a network has hooks")
    if not all(_is_plain_adam(network.optimizer) for network in (policy.actor, policy.critic)):
        kind = f"{policy.optimizer_class.__name__} with {policy.optimizer_kwargs}"
        found.append(f"an optimizer is not a plain Adam (the policy's: {kind})")
    if not all(p.requires_grad for network in (policy.actor, policy.critic) for p in network.parameters()):
        found.append("a parameter is frozen")
    if model.device.type != "cpu":
        found.append(f"the device is {model.device}")
    return found


def _is_plain_adam(optimizer: Any) -> bool:
    if type(optimizer) is not th.optim.Adam or len(optimizer.param_groups) != 1:
        return False
    group = optimizer.param_groups[0]
    return not (group["weight_decay"] or group["amsgrad"] or group["maximize"] or isinstance(group["lr"], th.Tensor))


def _has_hooks(modules: Iterable[nn.Module]) -> bool:
    return any(m._forward_hooks or m._forward_pre_hooks or m._backward_hooks or m._backward_pre_hooks for m in modules)


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
        self.steps = th.zeros(len(self.parameters))
        moments = (self.views(flat) for flat in (self.mean, self.square))
        for parameter, step, mean, square in zip(self.parameters, self.steps, *moments, strict=True):
            state = self.optimizer.state[parameter]
            if state:
                step.copy_(state["step"])
                mean.copy_(state["exp_avg"])
                square.copy_(state["exp_avg_sq"])
            self.optimizer.state[parameter] = {"step": step, "exp_avg": mean, "exp_avg_sq": square}
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
        """:return: whether network, targets and optimizer still use these tensors, and all of them learn"""
        state = self.optimizer.state
        return self.network.optimizer is self.optimizer and all(
            p.data_ptr() == value
            and target.data_ptr() == target_value
            and p.requires_grad
            and state.get(p, {}).get("exp_avg") is mean
            for p, value, target, target_value, mean in self.owned
        )

    def step(self) -> None:
        """One step of Adam along ``gradient``, as ``optimizer.step()`` would do it."""
        group = self.optimizer.param_groups[0]
        self.steps.add_(1)
        th._fused_adam_(
            [self.value],
            [self.gradient],
            [self.mean],
            [self.square],
            [],
            [self.steps[0]],
            lr=group["lr"],
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


class Layer:
    """
    A linear layer, of one network or of C stacked ones, as (in, out) views of its parameters (or of their gradients).

    :param weight: (in, out) or (C, in, out)
    :param bias: (1, out) or (C, 1, out)
    """

    def __init__(self, weight: th.Tensor, bias: th.Tensor):
        self.weight, self.bias = weight, bias
        self.affine: Any = th.baddbmm if weight.ndim == 3 else th.addmm
        self.matmul: Any = th.bmm if weight.ndim == 3 else th.mm

    def first(self) -> "Layer":
        """:return: the layer of the first critic alone"""
        return Layer(self.weight[0], self.bias[0])


def _layers(parameters: list[th.Tensor]) -> list[Layer]:
    """Of ``nn.Linear`` (out, in) or of ``StackedLinear`` (C, in, out), weight and bias in turn."""
    pairs = zip(parameters[::2], parameters[1::2], strict=True)
    return [Layer(w, b) if w.ndim == 3 else Layer(w.mT, b.unsqueeze(0)) for w, b in pairs]


class Mlp:
    """
    Forward and backward passes of linear layers with ReLU between them, on buffers that are kept.

    :param layers: of the network
    :param inputs: (B, in), filled before each pass
    :param activate_output: whether there is a ReLU behind the last layer too
    :param outputs: buffers for the outputs of the layers
    :param slopes: buffers for the slopes there; those of passes that are over by then keep the cache small
    """

    def __init__(
        self,
        layers: list[Layer],
        inputs: th.Tensor,
        activate_output: bool = False,
        outputs: list[th.Tensor] | None = None,
        slopes: list[th.Tensor] | None = None,
    ):
        self.layers, self.activate_output = layers, activate_output
        stacked = layers[0].weight.shape[:-2]
        if outputs is None:
            outputs = [inputs.new_empty(*stacked, len(inputs), layer.bias.shape[-1]) for layer in layers]
        self.activations = [inputs.expand(*stacked, -1, -1), *outputs]
        self.slopes = [th.empty_like(output) for output in outputs] if slopes is None else slopes

    def forward(self) -> th.Tensor:
        """:return: (B, out) or (C, B, out), overwritten by the next pass"""
        last = len(self.layers) - 1
        for i, layer in enumerate(self.layers):
            output = layer.affine(layer.bias, self.activations[i], layer.weight, out=self.activations[i + 1])
            if i < last or self.activate_output:
                output.relu_()
        return output

    def backward(self, slope: th.Tensor, gradients: list[Layer] | None) -> th.Tensor:
        """
        :param slope: of the loss at the output of the last layer (before a ReLU); the buffers of the last pass count
        :param gradients: where to write those of the parameters; None to go without
        :return: the slope at the output of the first layer, before its ReLU
        """
        for i in reversed(range(len(self.layers))):
            if gradients is not None:
                gradient = gradients[i]
                gradient.matmul(self.activations[i].mT, slope, out=gradient.weight)
                th.sum(slope, dim=-2, keepdim=True, out=gradient.bias)
            if i > 0:
                slope = self.layers[i].matmul(slope, self.layers[i].weight.mT, out=self.slopes[i - 1])
                relu_backward(slope, self.activations[i])
        return slope


def relu_backward(slope: th.Tensor, activation: th.Tensor) -> th.Tensor:
    """In place: no slope where the activation is 0."""
    return th.ops.aten.threshold_backward.grad_input(slope, activation, 0, grad_input=slope)


class DeterministicHead:
    """TD3's actor: a = tanh(f(s)) (Eq. 20)."""

    def __init__(self, layers: list[Layer], observations: th.Tensor):
        self.network = Mlp(layers, observations)

    def act(self) -> th.Tensor:
        """:return: (B, A), the mean action; overwritten by the next pass"""
        self.actions = self.network.forward().tanh_()
        return self.actions

    def backward(self, action_slope: th.Tensor, gradients: list[Layer]) -> None:
        """:param action_slope: (B, A), of the loss at the actions; overwritten"""
        slope = th.ops.aten.tanh_backward.grad_input(action_slope, self.actions, grad_input=action_slope)
        self.network.backward(slope, gradients)


class TanhGaussianHead:
    """SAC's actor: a = tanh(u), u = m(s) + σ(s)·ε (Eq. 21)."""

    def __init__(self, layers: list[Layer], observations: th.Tensor):
        *hidden, self.mean_layer, self.log_std_layer = layers
        self.network = Mlp(hidden, observations, activate_output=True)
        shape = (len(observations), self.mean_layer.bias.shape[-1])
        self.noise, self.mean, self.raw_log_std = (observations.new_empty(shape) for _ in range(3))

    def sample(self) -> th.Tensor:
        """:return: (B, A), a sample of the policy"""
        self.hidden = self.network.forward()
        th.addmm(self.mean_layer.bias, self.hidden, self.mean_layer.weight, out=self.mean)
        th.addmm(self.log_std_layer.bias, self.hidden, self.log_std_layer.weight, out=self.raw_log_std)
        self.log_std = self.raw_log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)
        self.spread = self.log_std.exp().mul_(self.noise.normal_())
        self.actions = (self.mean + self.spread).tanh_()
        return self.actions

    def log_prob(self) -> th.Tensor:
        """:return: (B,), log density of the last sample"""
        self.squash = 1 - self.actions.square()
        log_density = self.noise.square().mul_(-0.5).sub_(self.log_std).sub_(_LOG_SQRT_2_PI)
        return log_density.sub_((self.squash + _TANH_EPSILON).log_()).sum(dim=1)

    def backward(self, action_slope: th.Tensor, ent_coef: th.Tensor, gradients: list[Layer]) -> None:
        """
        The slope of mean(α·log π) is added here. log π = −½ε² − log σ − log(1 − a² + e) + const, at fixed ε, so that
        ∂log π/∂u = 2a(1 − a²)/(1 − a² + e), ∂u/∂m = 1, ∂u/∂log σ = σε, and log σ itself counts −1.

        :param action_slope: (B, A), of the loss without the entropy, at the actions
        :param ent_coef: (1,), α
        """
        coefficient = ent_coef / len(self.actions)
        ratio = (2 * coefficient) * self.actions / (self.squash + _TANH_EPSILON)
        mean_slope = (action_slope + ratio).mul_(self.squash)
        log_std_slope = (mean_slope * self.spread).sub_(coefficient)
        log_std_slope.mul_((self.raw_log_std >= LOG_STD_MIN) & (self.raw_log_std <= LOG_STD_MAX))
        *hidden, mean_gradient, log_std_gradient = gradients
        hidden_slope = None
        for slope, layer, gradient in (
            (mean_slope, self.mean_layer, mean_gradient),
            (log_std_slope, self.log_std_layer, log_std_gradient),
        ):
            th.mm(self.hidden.mT, slope, out=gradient.weight)
            th.sum(slope, dim=0, keepdim=True, out=gradient.bias)
            part = th.mm(slope, layer.weight.mT)
            hidden_slope = part if hidden_slope is None else hidden_slope.add_(part)
        assert hidden_slope is not None
        self.network.backward(relu_backward(hidden_slope, self.hidden), hidden)


class FusedUpdate:
    """
    The parts of one gradient step of a :class:`~sb3_tdc.tdc.tdc.TDC`, on static buffers.

    :param model: for which :func:`obstacles` found nothing; its parameters become views
    :param batch_size: B
    """

    def __init__(self, model: "TDC", batch_size: int):
        self.model, self.batch_size = model, batch_size
        self.modules = list(model.policy.modules())
        self.critic_adam = FlatAdam(model.critic, model.critic_target)
        self.actor_adam = FlatAdam(model.actor, model.actor_target)
        obs_dim = model.policy.actor.features_dim
        action_dim = get_action_dim(model.critic.action_space)

        def empty(*shape: int) -> th.Tensor:
            return th.empty(batch_size, *shape)

        # [s | a] and [s' | ã]; the actor reads from the first columns, its actions go to the last
        inputs, next_inputs = empty(obs_dim + action_dim), empty(obs_dim + action_dim)
        self.observations, self.actions = inputs[:, :obs_dim], inputs[:, obs_dim:]
        self.next_observations, self.next_actions = next_inputs[:, :obs_dim], next_inputs[:, obs_dim:]
        self.noise = empty(action_dim)

        online, target, gradient = self._networks(self.critic_adam)
        self.critic_gradient = gradient
        self.critic_target = Mlp(target, next_inputs)
        self.critic = Mlp(online, inputs, slopes=self.critic_target.activations[1:])
        self.loss_gradient = QuantileHuberGradient(self.critic.activations[-1], model.critic.n_quantiles)

        # Q₁: the hidden layers of the first critic, then the mean of its quantiles folded into the last layer
        *hidden, self.quantile_layer = (layer.first() for layer in online)
        outputs, slopes = (
            [buffer[0] for buffer in buffers[: len(hidden)]]
            for buffers in (self.critic.activations[1:], self.critic.slopes)
        )
        self.value = Mlp(hidden, inputs, activate_output=True, outputs=outputs, slopes=slopes)
        self.action_weight = online[0].weight[0, obs_dim:]  # (A, out)

        online, target, self.actor_gradient = self._networks(self.actor_adam)
        self.mean_layers = online[:-1] if model.stochastic_actor else online
        make_head = TanhGaussianHead if model.stochastic_actor else DeterministicHead
        self.head, self.target_head = make_head(online, self.observations), make_head(target, self.next_observations)

    @staticmethod
    def _networks(adam: FlatAdam) -> list[list[Layer]]:
        """Online, target, gradient."""
        return [_layers(adam.views(flat)) for flat in (adam.value, adam.target, adam.gradient)]

    def fits(self, batch_size: int) -> bool:
        """:return: whether the buffers are of this size, and all that :func:`obstacles` looks at is as it was"""
        adams = (self.critic_adam, self.actor_adam)
        return (
            batch_size == self.batch_size
            and all(_is_plain_adam(adam.optimizer) and adam.owns_parameters() for adam in adams)
            and not _has_hooks(self.modules)
        )

    def act(self, observations: np.ndarray) -> np.ndarray:
        """
        :param observations: (n, D)
        :return: (n, A), the mean actions in [-1, 1]
        """
        hidden = th.from_numpy(np.asarray(observations, dtype=np.float32))
        *hidden_layers, output = self.mean_layers
        for layer in hidden_layers:
            hidden = th.addmm(layer.bias, hidden, layer.weight).relu_()
        return th.addmm(output.bias, hidden, output.weight).tanh_().numpy()

    def _set_target_actions(self, replay_data: ReplayBufferSamples) -> None:
        self.next_observations.copy_(replay_data.next_observations)
        if isinstance(self.target_head, TanhGaussianHead):
            self.next_actions.copy_(self.target_head.sample())  # Eq. 2
            return
        model = self.model
        noise = self.noise.normal_().mul_(model.target_policy_noise)
        noise.clamp_(-model.target_noise_clip, model.target_noise_clip)
        th.clamp(noise.add_(self.target_head.act()), -1, 1, out=self.next_actions)  # Eq. 1

    def update_critics(self, replay_data: ReplayBufferSamples, lam: float) -> None:
        """``TDC.update_critics``"""
        model = self.model
        self._set_target_actions(replay_data)
        quantiles = self.critic_target.forward()  # Eq. 3, (C, B, N)
        discounts = replay_data.discounts if replay_data.discounts is not None else model.gamma
        target = lcb_target(  # Eq. 4–7
            quantiles.transpose(0, 1), replay_data.rewards, replay_data.dones, discounts, lam
        )

        self.observations.copy_(replay_data.observations)
        self.actions.copy_(replay_data.actions)
        current = self.critic.forward()
        slope = self.loss_gradient(current, target.quantiles, model.kappa)  # Eq. 8–10
        self.critic.backward(slope, self.critic_gradient)
        self.critic_adam.step()
        if model.diagnoses_critics:
            model.diagnose_critics(current.transpose(0, 1), target)

    def _value_and_slope(self) -> tuple[th.Tensor, th.Tensor]:
        """Q₁ (Eq. 11) of the actions in the inputs, (B,), and the slope of −mean Q₁ at these actions, (B, A)."""
        hidden = self.value.forward()
        weight, bias = self.quantile_layer.weight.mean(dim=1), self.quantile_layer.bias.mean()
        slope = (weight / -self.batch_size).expand_as(hidden).clone()
        slope = self.value.backward(relu_backward(slope, hidden), gradients=None)
        return hidden @ weight + bias, slope @ self.action_weight.mT

    def update_actor(self, replay_data: ReplayBufferSamples) -> None:
        """``TDC.update_actor``, on the observations of the critics' update"""
        model, head = self.model, self.head
        if isinstance(head, TanhGaussianHead):
            self.actions.copy_(head.sample())
            log_prob, ent_coef = head.log_prob(), model.current_ent_coef()
            values, slope = self._value_and_slope()
            head.backward(slope, ent_coef, self.actor_gradient)
            self.actor_adam.step()
            model.update_temperature(log_prob, ent_coef, (ent_coef * log_prob - values).mean())  # Eq. 13
        else:
            self.actions.copy_(head.act())
            values, slope = self._value_and_slope()
            head.backward(slope, self.actor_gradient)
            self.actor_adam.step()
            model.diagnose(actor_loss=-values.mean())  # Eq. 12

    def update_targets(self) -> None:
        """``TDC.update_targets``"""
        for adam in (self.critic_adam, self.actor_adam):
            adam.update_targets(self.model.tau)
