"""One gradient step on preallocated buffers. Shapes: C critics, B transitions, N quantiles, D observation, A action."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_tdc.tdc.compiled import load_kernels
from sb3_tdc.tdc.fused import passes
from sb3_tdc.tdc.fused.adam import AdamStep
from sb3_tdc.tdc.fused.graphs import CudaGraphs
from sb3_tdc.tdc.fused.networks import DeterministicHead, Layer, Mlp, TanhGaussianHead, make_layers
from sb3_tdc.tdc.fused.passes import Passes
from sb3_tdc.tdc.fused.replay import PackedReplay, row_widths
from sb3_tdc.tdc.fused.scalar import Scalar
from sb3_tdc.tdc.fused.snapshot import ModuleSnapshot, Snapshot
from sb3_tdc.tdc.quantiles import Target

_COLUMNS = ("observations", "actions", "next_observations", "dones", "rewards")


def _call(function: Callable[[], Any]) -> Any:
    return function()


class FusedUpdate:
    """
    One gradient step of TDC on preallocated buffers; ``TDC.update`` is the readable version.

    On CUDA each part is one graph, and the minibatch comes from a copy of the replay buffer on the device.

    :param model: a ``TDC`` for which :func:`obstacles` found nothing; the step counts of its optimizers become views
    :param batch_size: B
    """

    def __init__(self, model: Any, batch_size: int):
        self.model, self.batch_size = model, batch_size
        self.critic_adam = AdamStep(model.critic, model.critic_target)
        self.actor_adam = AdamStep(model.actor, model.actor_target)
        self.snapshot = Snapshot(model)
        self.policy, self.actor_snapshot = model.policy, ModuleSnapshot([model.policy, *model.actor.modules()])
        self.run: Callable[[Callable[[], Any]], Any] = CudaGraphs() if model.device.type == "cuda" else _call
        self.packed_replay: PackedReplay | None = None
        self.bind = Passes(load_kernels() if model.device.type == "cpu" else None)
        self._make_buffers(model.policy.actor.features_dim, get_action_dim(model.critic.action_space))
        self._make_critics()
        self._make_actors()

    def _make_buffers(self, obs_dim: int, action_dim: int) -> None:
        def empty(*shape: int) -> th.Tensor:
            return th.empty(shape, dtype=th.float32, device=self.model.device)

        batch_size = self.batch_size
        widths = row_widths(obs_dim, action_dim)
        self.rows = empty(batch_size, sum(widths))  # in the format of a PackedReplay
        observations, actions, self.drawn_next_observations, rewards, dones, self.timeouts = self.rows.split(widths, 1)
        # [s | a] and [s' | ã]; an actor reads the first columns and writes its actions to the last
        self.inputs, self.next_inputs = self.rows[:, : obs_dim + action_dim], empty(batch_size, obs_dim + action_dim)
        next_observations, self.next_actions = self.next_inputs.split([obs_dim, action_dim], 1)
        self.minibatch = ReplayBufferSamples(observations, actions, next_observations, dones, rewards)
        self.noise = empty(batch_size, action_dim)
        self.discounts, self.lam = Scalar(empty(batch_size, 1)), Scalar(empty(1))
        self.ent_coef = empty(1)

    def _make_critics(self) -> None:
        batch, bind = self.minibatch, self.bind
        online, target, gradient = self._networks(self.critic_adam)
        self.critic_target = Mlp(target, self.next_inputs)
        # When the gradients are written, the target critics' outputs are no longer needed: their buffers are reused
        self.critic = Mlp(online, self.inputs, gradient, grad_outputs=self.critic_target.outputs)

        next_quantiles, current = self.critic_target.outputs[-1], self.critic.outputs[-1]
        n_critics, batch_size, n_quantiles = next_quantiles.shape
        mean, std = current.new_empty(n_critics, batch_size), current.new_empty(n_critics, batch_size)
        selected = th.empty(batch_size, dtype=th.int64, device=current.device)
        self.target = Target(current.new_empty(batch_size, n_quantiles), mean.mT, std.mT, selected)
        transitions = (batch.rewards, batch.dones, self.discounts.tensor, self.lam.tensor)
        results = (mean, std, selected, self.target.quantiles)
        self.set_target = bind(passes.lcb_target, next_quantiles, *transitions, *results)
        written = self.critic.grad_outputs[-1], gradient[-1].bias
        self.compute_loss_gradient = bind(passes.quantile_huber_gradient, current, self.target.quantiles, *written)

        # Q₁: the hidden layers of the first critic, then the mean of its quantiles folded into the last layer
        *hidden, last = (layer.first() for layer in online)
        outputs, grad_outputs = (
            [buffer[0] for buffer in buffers[: len(hidden)]]
            for buffers in (self.critic.outputs, self.critic.grad_outputs)
        )
        self.value = Mlp(hidden, self.inputs, activate_output=True, outputs=outputs, grad_outputs=grad_outputs)
        self.values = current.new_empty(batch_size)
        self.set_values = bind(passes.mean_value, outputs[-1], last.weight, last.bias, grad_outputs[-1], self.values)
        self.action_weight = online[0].weight[0, batch.observations.shape[1] :].mT  # (out, A)

    def _make_actors(self) -> None:
        batch, bind = self.minibatch, self.bind
        online, target, gradient = self._networks(self.actor_adam)
        self.mean_layers = online[:-1] if self.model.stochastic_actor else online
        if bind.kernels is not None:
            self.mean_rows = [
                (layer.weight.mT.numpy(), layer.bias[0].numpy(), np.empty(layer.bias.shape[1], np.float32))
                for layer in self.mean_layers
            ]
        if self.model.stochastic_actor:
            self.head: Any = TanhGaussianHead(online, batch.observations, batch.actions, bind, gradient, self.ent_coef)
            self.target_head: Any = TanhGaussianHead(target, batch.next_observations, self.next_actions, bind)
        else:
            self.head = DeterministicHead(online, batch.observations, batch.actions, bind, gradient)
            self.target_head = DeterministicHead(target, batch.next_observations, self.next_actions, bind)
            self.smooth = bind(passes.smooth_actions, self.noise, self.next_actions)

    @staticmethod
    def _networks(adam: AdamStep) -> list[list[Layer]]:
        """Return the layers of the online network, of its target, and of its gradients."""
        return [make_layers(tensors) for tensors in (adam.values, adam.targets, adam.gradients)]

    def fits(self, batch_size: int) -> bool:
        """Return whether the buffers have this batch size, and everything that an update relies on is unchanged."""
        return batch_size == self.batch_size and self.snapshot.is_current()

    def __deepcopy__(self, memo: dict[int, Any]) -> None:
        """Return None: a copy of the model binds a new update to its own networks."""

    def __reduce__(self) -> tuple[Any, ...]:
        return type(None), ()  # an unpickled model also binds a new update

    def step(self, lam: float) -> None:
        """Do what ``TDC.update`` does, on a minibatch of the model's replay buffer."""
        model = self.model
        replay_data = self.sample()
        if len(replay_data.rewards) != self.batch_size:  # a custom replay buffer may return fewer transitions
            model.update(replay_data, lam)
            return
        self.update_critics(replay_data, lam)
        if model._n_updates % model.policy_delay == 0:
            self.update_actor()
            self.update_targets()
        if model.diagnoses_units:
            model.diagnose_units(replay_data.observations)  # the actor has overwritten the actions

    def sample(self) -> ReplayBufferSamples:
        """Return a minibatch of the model's replay buffer; from a packed one, the next minibatch overwrites it."""
        model, packed = self.model, self._find_packed_replay()
        if packed is None:
            return model.replay_buffer.sample(self.batch_size, env=model._vec_normalize_env)
        self.gather(packed.draw(model.replay_buffer, self.batch_size, model.num_timesteps // model.n_envs))
        return self.minibatch

    def _find_packed_replay(self) -> PackedReplay | None:
        """Return the packed rows of the model's replay buffer, or None where they cannot be used."""
        buffer = self.model.replay_buffer
        if self.model._vec_normalize_env is not None:
            return None
        if self.packed_replay is None or not self.packed_replay.holds(buffer):
            self.packed_replay = PackedReplay.of(buffer)
            if self.packed_replay is not None:
                self.gather = self._bind_gather(self.packed_replay)
        return self.packed_replay

    def _bind_gather(self, packed: PackedReplay) -> Callable[..., Any]:
        batch = self.minibatch
        next_observations = self.drawn_next_observations, batch.next_observations
        return self.bind(passes.gather, packed.rows, self.rows, *next_observations, batch.dones, self.timeouts)

    def acts(self) -> bool:
        """Return whether :meth:`act` still computes what the policy does."""
        model = self.model
        return model.policy is self.policy and self.actor_snapshot.is_current() and not model.overrides_methods()

    def act(self, observations: np.ndarray) -> np.ndarray:
        """
        Compute the mean actions, as ``policy.predict`` does.

        :param observations: (n, D)
        :return: (n, A), the mean actions in [-1, 1]
        """
        hidden = np.ascontiguousarray(observations, dtype=np.float32)
        if len(hidden) == 1 and self.bind.kernels is not None:
            return self._act_once(self.bind.kernels.affine_row, hidden[0])
        *hidden_layers, output = self.mean_layers
        outputs = th.as_tensor(hidden, device=self.model.device)
        for layer in hidden_layers:
            outputs = th.addmm(layer.bias, outputs, layer.weight).relu_()
        return th.addmm(output.bias, outputs, output.weight).tanh_().cpu().numpy()

    def _act_once(self, affine_row: Callable[..., Any], hidden: np.ndarray) -> np.ndarray:
        for weight, bias, outputs in self.mean_rows:
            affine_row(hidden, weight, bias, outputs, outputs is not self.mean_rows[-1][2])
            hidden = outputs
        return np.tanh(hidden)[None]

    def update_critics(self, replay_data: ReplayBufferSamples, lam: float) -> None:
        """Do what ``TDC.update_critics`` does."""
        model, discounts = self.model, replay_data.discounts
        self.lam.set(lam)
        self.critic_adam.read_learning_rate()
        if replay_data is not self.minibatch:
            for name in _COLUMNS:  # by name: a custom minibatch may have them in another order
                getattr(self.minibatch, name).copy_(getattr(replay_data, name))
        if discounts is None:
            self.discounts.set(model.gamma)
        else:
            self.discounts.copy_(discounts)
        self.run(self._update_critics)
        self.critic_adam.show_gradients()
        if model.diagnoses_critics:
            model.diagnose_critics(self.critic.outputs[-1].transpose(0, 1), self.target)

    def _update_critics(self) -> None:
        self._set_target_actions()
        self.critic_target.forward()  # Eq. 3
        self.set_target()  # Eq. 4–7
        self.critic.forward()
        self.compute_loss_gradient(self.model.kappa)  # Eq. 8–10
        self.critic.backward()
        self.critic_adam.step()

    def _set_target_actions(self) -> None:
        self.target_head.act()  # Eq. 2
        if not self.model.stochastic_actor:
            self.noise.normal_(0, self.model.target_policy_noise)
            self.smooth(self.model.target_noise_clip)  # Eq. 1

    def update_actor(self) -> None:
        """Do what ``TDC.update_actor`` does, on the observations of the critics' update."""
        model = self.model
        self.actor_adam.read_learning_rate()
        self.actor_adam.show_gradients()
        if not model.stochastic_actor:
            model.diagnose(actor_loss=self.run(self._update_deterministic_actor).clone())
            return
        ent_coef = model.current_ent_coef()
        self.ent_coef.copy_(ent_coef)
        actor_loss, log_prob = self.run(self._update_stochastic_actor)
        model.update_temperature(log_prob, ent_coef, actor_loss.clone())

    def _update_deterministic_actor(self) -> th.Tensor:
        self.head.act()
        self._compute_value_gradient()
        self.head.backward()
        self.actor_adam.step()
        return -self.values.mean()  # Eq. 12

    def _update_stochastic_actor(self) -> tuple[th.Tensor, th.Tensor]:
        self.head.act()
        log_prob = self.head.log_prob()
        self._compute_value_gradient()
        self.head.backward()
        self.actor_adam.step()
        return (self.ent_coef * log_prob - self.values).mean(), log_prob  # Eq. 13

    def _compute_value_gradient(self) -> None:
        """Compute Q₁ (Eq. 11) of the actions in the inputs, and the gradient of −mean Q₁ at these actions."""
        self.value.forward()
        self.set_values()
        th.mm(self.value.backward(), self.action_weight, out=self.head.grad_actions)

    def update_targets(self) -> None:
        """Do what ``TDC.update_targets`` does."""
        self.run(self._update_targets)

    def _update_targets(self) -> None:
        for adam in (self.critic_adam, self.actor_adam):
            adam.update_targets(self.model.tau)
