"""One gradient step on static buffers. Shapes: C critics, B transitions, N quantiles, D observation, A action."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_tdc.tdc.fused.applicability import has_hooks, is_plain_adam
from sb3_tdc.tdc.fused.flat_adam import FlatAdam
from sb3_tdc.tdc.fused.graphs import CudaGraphs
from sb3_tdc.tdc.fused.networks import DeterministicHead, Layer, Mlp, TanhGaussianHead, make_layers, relu_backward
from sb3_tdc.tdc.fused.replay import PackedReplay
from sb3_tdc.tdc.quantiles import QuantileHuberGradient, Target, lcb_target

if TYPE_CHECKING:
    from sb3_tdc.tdc.tdc import TDC


def _call(function: Callable[[], Any]) -> Any:
    return function()


class FusedUpdate:
    """
    The parts of one gradient step of a :class:`~sb3_tdc.tdc.tdc.TDC`, on static buffers.

    On CUDA each part is one graph, and the batch comes from a copy of the replay buffer on the device.

    :param model: for which :func:`obstacles` found nothing; its parameters become views
    :param batch_size: B
    :param packed_replay: of an update before this one; it counts where it still holds the model's replay buffer
    """

    def __init__(self, model: "TDC", batch_size: int, packed_replay: PackedReplay | None = None):
        self.model, self.batch_size = model, batch_size
        self.modules = list(model.policy.modules())
        self.critic_adam = FlatAdam(model.critic, model.critic_target)
        self.actor_adam = FlatAdam(model.actor, model.actor_target)
        self.constants = self._read_constants()
        self.run: Callable[[Callable[[], Any]], Any] = CudaGraphs() if model.device.type == "cuda" else _call
        self.packed_replay = packed_replay
        obs_dim = model.policy.actor.features_dim
        action_dim = get_action_dim(model.critic.action_space)

        def empty(*shape: int) -> th.Tensor:
            return th.empty(shape, device=model.device)

        # [s | a] and [s' | ã]; the actor reads from the first columns, its actions go to the last
        inputs, next_inputs = (empty(batch_size, obs_dim + action_dim) for _ in range(2))
        self.observations, self.actions = inputs[:, :obs_dim], inputs[:, obs_dim:]
        self.next_observations, self.next_actions = next_inputs[:, :obs_dim], next_inputs[:, obs_dim:]
        self.rewards, self.dones, self.discounts = (empty(batch_size, 1) for _ in range(3))
        self.noise = empty(batch_size, action_dim)
        self.lam, self.ent_coef = empty(), empty(1)

        online, target, self.critic_gradient = self._networks(self.critic_adam)
        self.critic_target = Mlp(target, next_inputs)
        self.critic = Mlp(online, inputs, slopes=self.critic_target.activations[1:])
        compiled = model.fused_kwargs.get("compile_loss", False)
        self.loss_gradient = QuantileHuberGradient(self.critic.activations[-1], model.critic.n_quantiles, compiled)

        # Q₁: the hidden layers of the first critic, then the mean of its quantiles folded into the last layer
        *hidden, self.quantile_layer = (layer.first() for layer in online)
        outputs, slopes = (
            [buffer[0] for buffer in buffers[: len(hidden)]]
            for buffers in (self.critic.activations[1:], self.critic.slopes)
        )
        self.value = Mlp(hidden, inputs, activate_output=True, outputs=outputs, slopes=slopes)
        self.action_weight = online[0].weight[0, obs_dim:]  # (A, out)

        online, target, self.actor_gradient = self._networks(self.actor_adam, n_outputs=1 + model.stochastic_actor)
        self.mean_layers = online[:-1] if model.stochastic_actor else online
        make_head = TanhGaussianHead if model.stochastic_actor else DeterministicHead
        self.head, self.target_head = make_head(online, self.observations), make_head(target, self.next_observations)

    def _networks(self, adam: FlatAdam, n_outputs: int = 1) -> list[list[Layer]]:
        """Online, target, gradient."""
        bfloat16 = self.model.fused_kwargs.get("bfloat16", False)
        return [make_layers(adam.views(flat), n_outputs, bfloat16) for flat in (adam.value, adam.target, adam.gradient)]

    def _read_constants(self) -> tuple[Any, ...]:
        """What is read from Python in a part of an update, and so stays as it was in a CUDA graph."""
        model = self.model
        groups = [adam.optimizer.param_groups[0] for adam in (self.critic_adam, self.actor_adam)]
        options = tuple(sorted(model.fused_kwargs.items()))
        return (
            *(model.kappa, model.tau, model.target_policy_noise, model.target_noise_clip, options),
            *((group["betas"], group["eps"]) for group in groups),
        )

    def fits(self, batch_size: int) -> bool:
        """:return: whether the buffers are of this size, and all that :func:`obstacles` looks at is as it was"""
        adams = (self.critic_adam, self.actor_adam)
        return (
            batch_size == self.batch_size
            and all(is_plain_adam(adam.optimizer) and adam.owns_parameters() for adam in adams)
            and self.constants == self._read_constants()
            and not has_hooks(self.modules)
        )

    def sample(self, batch_size: int) -> ReplayBufferSamples:
        """:return: a minibatch of the model's replay buffer"""
        model = self.model
        buffer, normalization = model.replay_buffer, model._vec_normalize_env
        if normalization is not None or not PackedReplay.applies(buffer):
            return buffer.sample(batch_size, env=normalization)
        if self.packed_replay is None or not self.packed_replay.holds(buffer):
            self.packed_replay = PackedReplay(buffer)
        return self.packed_replay.sample(batch_size, model.num_timesteps // model.n_envs)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """
        :param observations: (n, D)
        :return: (n, A), the mean actions in [-1, 1]
        """
        hidden = th.as_tensor(np.asarray(observations, dtype=np.float32), device=self.model.device)
        *hidden_layers, output = self.mean_layers
        for layer in hidden_layers:
            hidden = th.addmm(layer.bias, hidden, layer.weight).relu_()
        return th.addmm(output.bias, hidden, output.weight).tanh_().cpu().numpy()

    def update_critics(self, replay_data: ReplayBufferSamples, lam: float) -> None:
        """``TDC.update_critics``"""
        model = self.model
        self.lam.fill_(lam)
        self.critic_adam.read_learning_rate()
        self.observations.copy_(replay_data.observations)
        self.actions.copy_(replay_data.actions)
        self.next_observations.copy_(replay_data.next_observations)
        self.rewards.copy_(replay_data.rewards)
        self.dones.copy_(replay_data.dones)
        if replay_data.discounts is None:
            self.discounts.fill_(model.gamma)
        else:
            self.discounts.copy_(replay_data.discounts)
        current, target = self.run(self._update_critics)
        if model.diagnoses_critics:
            model.diagnose_critics(current.transpose(0, 1), target)

    def _update_critics(self) -> tuple[th.Tensor, Target]:
        self._set_target_actions()
        quantiles = self.critic_target.forward()  # Eq. 3, (C, B, N)
        target = lcb_target(  # Eq. 4–7
            quantiles.transpose(0, 1), self.rewards, self.dones, self.discounts, self.lam
        )
        current = self.critic.forward()
        slope = self.loss_gradient(current, target.quantiles, self.model.kappa)  # Eq. 8–10
        self.critic.backward(slope, self.critic_gradient)
        self.critic_adam.step()
        return current, target

    def _set_target_actions(self) -> None:
        if isinstance(self.target_head, TanhGaussianHead):
            self.next_actions.copy_(self.target_head.sample())  # Eq. 2
            return
        model = self.model
        noise = self.noise.normal_().mul_(model.target_policy_noise)
        noise.clamp_(-model.target_noise_clip, model.target_noise_clip)
        th.clamp(noise.add_(self.target_head.act()), -1, 1, out=self.next_actions)  # Eq. 1

    def update_actor(self, replay_data: ReplayBufferSamples) -> None:
        """``TDC.update_actor``, on the observations of the critics' update"""
        model = self.model
        self.actor_adam.read_learning_rate()
        if not model.stochastic_actor:
            model.diagnose(actor_loss=self.run(self._update_deterministic_actor).clone())
            return
        ent_coef = model.current_ent_coef()
        self.ent_coef.copy_(ent_coef)
        actor_loss, log_prob = self.run(self._update_stochastic_actor)
        model.update_temperature(log_prob, ent_coef, actor_loss.clone())

    def _update_deterministic_actor(self) -> th.Tensor:
        head = self.head
        assert isinstance(head, DeterministicHead)
        self.actions.copy_(head.act())
        values, slope = self._value_and_slope()
        head.backward(slope, self.actor_gradient)
        self.actor_adam.step()
        return -values.mean()  # Eq. 12

    def _update_stochastic_actor(self) -> tuple[th.Tensor, th.Tensor]:
        head = self.head
        assert isinstance(head, TanhGaussianHead)
        self.actions.copy_(head.sample())
        log_prob = head.log_prob()
        values, slope = self._value_and_slope()
        head.backward(slope, self.ent_coef, self.actor_gradient)
        self.actor_adam.step()
        return (self.ent_coef * log_prob - values).mean(), log_prob  # Eq. 13

    def _value_and_slope(self) -> tuple[th.Tensor, th.Tensor]:
        """Q₁ (Eq. 11) of the actions in the inputs, (B,), and the slope of −mean Q₁ at these actions, (B, A)."""
        hidden = self.value.forward()
        weight, bias = self.quantile_layer.weight.mean(dim=1), self.quantile_layer.bias.mean()
        slope = (weight / -self.batch_size).expand_as(hidden).clone()
        slope = self.value.backward(relu_backward(slope, hidden), gradients=None)
        return hidden @ weight + bias, slope @ self.action_weight.mT

    def update_targets(self) -> None:
        """``TDC.update_targets``"""
        self.run(self._update_targets)

    def _update_targets(self) -> None:
        for adam in (self.critic_adam, self.actor_adam):
            adam.update_targets(self.model.tau)
