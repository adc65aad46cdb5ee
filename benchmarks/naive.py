"""A naive implementation of TDC-λ, only to compare speed: separate networks, autograd through all quantile pairs."""

from typing import Any

import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.td3.policies import TD3Policy
from torch import nn


class NaiveCritic(ContinuousCritic):
    """Two critics of N quantiles."""

    def __init__(self, *args: Any, n_quantiles: int = 64, **kwargs: Any):
        super().__init__(*args, **kwargs)
        features = kwargs["features_dim"] + self.action_space.shape[0]
        for i in range(self.n_critics):
            network = nn.Sequential(*create_mlp(features, n_quantiles, kwargs["net_arch"], kwargs["activation_fn"]))
            self.q_networks[i] = network
            setattr(self, f"qf{i}", network)


class NaivePolicy(TD3Policy):
    """TD3's policy with the critics of :class:`NaiveCritic`."""

    def make_critic(self, features_extractor: Any = None) -> NaiveCritic:
        return NaiveCritic(**self._update_features_extractor(self.critic_kwargs, features_extractor)).to(self.device)


class NaiveTDC(TD3):
    """TDC with the deterministic head: the training loop of SB3's TD3 with the losses of the paper."""

    lam, kappa = 1.0, 1.0

    def _loss(self, current: th.Tensor, target: th.Tensor) -> th.Tensor:
        n = current.shape[1]
        levels = (th.arange(n) + 0.5) / n
        delta = target[:, None, :] - current[:, :, None]
        size = delta.abs()
        huber = th.where(size <= self.kappa, 0.5 * delta**2, self.kappa * (size - 0.5 * self.kappa))
        return ((levels[None, :, None] - (delta.detach() < 0).float()).abs() * huber).mean()

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        self.policy.set_training_mode(True)
        for _ in range(gradient_steps):
            self._n_updates += 1
            data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            with th.no_grad():
                noise = (th.randn_like(data.actions) * self.target_policy_noise).clamp(-0.5, 0.5)
                next_actions = (self.actor_target(data.next_observations) + noise).clamp(-1, 1)
                quantiles = th.stack(self.critic_target(data.next_observations, next_actions), dim=1)
                score = quantiles.mean(dim=2) - self.lam * quantiles.std(dim=2, correction=0)
                index = score.argmin(dim=1)[:, None, None].expand(-1, 1, quantiles.shape[2])
                target = data.rewards + (1 - data.dones) * self.gamma * quantiles.gather(1, index)[:, 0]
            loss = sum(self._loss(current, target) for current in self.critic(data.observations, data.actions))
            self.critic.optimizer.zero_grad()
            loss.backward()
            self.critic.optimizer.step()
            if self._n_updates % self.policy_delay == 0:
                actor_loss = -self.critic.q1_forward(data.observations, self.actor(data.observations)).mean()
                self.actor.optimizer.zero_grad()
                actor_loss.backward()
                self.actor.optimizer.step()
                polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
                polyak_update(self.actor.parameters(), self.actor_target.parameters(), self.tau)
