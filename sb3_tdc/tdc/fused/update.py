"""One gradient step on static buffers. Shapes: C critics, B transitions, N quantiles, D observation, A action."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_tdc.tdc.fused.applicability import hooks
from sb3_tdc.tdc.fused.flat_adam import FlatAdam
from sb3_tdc.tdc.fused.graphs import CudaGraphs
from sb3_tdc.tdc.fused.networks import DeterministicHead, Layer, Mlp, TanhGaussianHead, make_layers, relu_backward
from sb3_tdc.tdc.fused.replay import PackedReplay, row_widths
from sb3_tdc.tdc.fused.scalar import Scalar
from sb3_tdc.tdc.fused.target import LcbTarget
from sb3_tdc.tdc.quantiles import QuantileHuberGradient

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
        self.hooks = hooks(model.policy)
        self.critic_adam = FlatAdam(model.critic, model.critic_target)
        self.actor_adam = FlatAdam(model.actor, model.actor_target)
        self.constants = self._read_constants()
        self.run: Callable[[Callable[[], Any]], Any] = CudaGraphs() if model.device.type == "cuda" else _call
        self.packed_replay = packed_replay
        self._make_buffers(model.policy.actor.features_dim, get_action_dim(model.critic.action_space))
        self._make_critics()
        self._make_actors()

    def _make_buffers(self, obs_dim: int, action_dim: int) -> None:
        def empty(*shape: int) -> th.Tensor:
            return th.empty(shape, device=self.model.device)

        batch_size = self.batch_size
        widths = row_widths(obs_dim, action_dim)
        self.rows = empty(batch_size, sum(widths))  # as a PackedReplay holds them
        observations, actions, self.drawn_next_observations, rewards, dones, self.timeouts = self.rows.split(widths, 1)
        # [s | a] and [s' | ã]; the actor reads from the first columns, its actions go to the last
        self.inputs, self.next_inputs = self.rows[:, : obs_dim + action_dim], empty(batch_size, obs_dim + action_dim)
        next_observations, self.next_actions = self.next_inputs.split([obs_dim, action_dim], 1)
        self.minibatch = ReplayBufferSamples(observations, actions, next_observations, dones, rewards)
        self.noise = empty(batch_size, action_dim)
        self.discounts, self.lam = Scalar(empty(batch_size, 1)), Scalar(empty())
        self.ent_coef = empty(1)

    def _make_critics(self) -> None:
        model, batch = self.model, self.minibatch
        online, target, gradient = self._networks(self.critic_adam)
        self.critic_target = Mlp(target, self.next_inputs)
        self.target = LcbTarget(
            self.critic_target.outputs[-1], batch.rewards, batch.dones, self.discounts.tensor, self.lam.tensor
        )
        self.critic = Mlp(online, self.inputs, gradient, slopes=self.critic_target.outputs)
        compiled = model.fused_kwargs.get("compile_loss", False)
        self.loss_gradient = QuantileHuberGradient(self.critic.outputs[-1], self.target.quantiles, compiled)

        # Q₁: the hidden layers of the first critic, then the mean of its quantiles folded into the last layer
        *hidden, self.quantile_layer = (layer.first() for layer in online)
        outputs, slopes = (
            [buffer[0] for buffer in buffers[: len(hidden)]] for buffers in (self.critic.outputs, self.critic.slopes)
        )
        self.value = Mlp(hidden, self.inputs, activate_output=True, outputs=outputs, slopes=slopes)
        self.action_weight = online[0].weight[0, batch.observations.shape[1] :].mT  # (out, A)

    def _make_actors(self) -> None:
        model, batch = self.model, self.minibatch
        online, target, gradient = self._networks(self.actor_adam, n_outputs=1 + model.stochastic_actor)
        self.mean_layers = online[:-1] if model.stochastic_actor else online
        make_head: Any = TanhGaussianHead if model.stochastic_actor else DeterministicHead
        self.head = make_head(online, batch.observations, batch.actions, gradient)
        self.target_head = make_head(target, batch.next_observations, self.next_actions)

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
        return (
            batch_size == self.batch_size
            and self.critic_adam.owns_parameters()
            and self.actor_adam.owns_parameters()
            and self.constants == self._read_constants()
            and not any(self.hooks)
        )

    def sample(self, batch_size: int) -> ReplayBufferSamples:
        """:return: a minibatch of the model's replay buffer; of a packed one, overwritten by the next"""
        model, packed = self.model, self._find_packed_replay()
        if packed is None:
            return model.replay_buffer.sample(batch_size, env=model._vec_normalize_env)
        packed.sample(self.rows, model.num_timesteps // model.n_envs)
        batch = self.minibatch
        batch.next_observations.copy_(self.drawn_next_observations)
        batch.dones.addcmul_(batch.dones, self.timeouts, value=-1)  # terminated
        return batch

    def _find_packed_replay(self) -> PackedReplay | None:
        """The model's replay buffer as rows, where that is possible."""
        buffer = self.model.replay_buffer
        if self.model._vec_normalize_env is not None:
            return None
        if self.packed_replay is None or not self.packed_replay.holds(buffer):
            if not PackedReplay.applies(buffer):
                return None
            self.packed_replay = PackedReplay(buffer)
        return self.packed_replay

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
        model, discounts = self.model, replay_data.discounts
        self.lam.set(lam)
        self.critic_adam.read_learning_rate()
        if replay_data is not self.minibatch:
            for mine, other in zip(self.minibatch[:5], replay_data[:5], strict=True):
                mine.copy_(other)
        if discounts is None:
            self.discounts.set(model.gamma)
        else:
            self.discounts.copy_(discounts)
        self.run(self._update_critics)
        if model.diagnoses_critics:
            model.diagnose_critics(self.critic.outputs[-1].transpose(0, 1), self.target.details())

    def _update_critics(self) -> None:
        self._set_target_actions()
        self.critic_target.forward()  # Eq. 3
        self.target.compute()  # Eq. 4–7
        self.critic.forward()
        self.critic.backward(self.loss_gradient(self.model.kappa))  # Eq. 8–10
        self.critic_adam.step()

    def _set_target_actions(self) -> None:
        actions, model = self.target_head.act(), self.model  # Eq. 2
        if not model.stochastic_actor:
            noise = self.noise.normal_(0, model.target_policy_noise)
            noise.clamp_(-model.target_noise_clip, model.target_noise_clip)
            actions.add_(noise).clamp_(-1, 1)  # Eq. 1

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
        self.head.act()
        values, slope = self._value_and_slope()
        self.head.backward(slope)
        self.actor_adam.step()
        return -values.mean()  # Eq. 12

    def _update_stochastic_actor(self) -> tuple[th.Tensor, th.Tensor]:
        self.head.act()
        log_prob = self.head.log_prob()
        values, slope = self._value_and_slope()
        self.head.backward(slope, self.ent_coef)
        self.actor_adam.step()
        return (self.ent_coef * log_prob - values).mean(), log_prob  # Eq. 13

    def _value_and_slope(self) -> tuple[th.Tensor, th.Tensor]:
        """Q₁ (Eq. 11) of the actions in the inputs, (B,), and the slope of −mean Q₁ at these actions, (B, A)."""
        hidden = self.value.forward()
        weight, bias = self.quantile_layer.weight.mean(dim=1), self.quantile_layer.bias.mean()
        slope = relu_backward((weight / -self.batch_size).expand_as(hidden), hidden, out=self.value.slopes[-1])
        return hidden @ weight + bias, self.value.backward(slope) @ self.action_weight

    def update_targets(self) -> None:
        """``TDC.update_targets``"""
        self.run(self._update_targets)

    def _update_targets(self) -> None:
        for adam in (self.critic_adam, self.actor_adam):
            adam.update_targets(self.model.tau)
