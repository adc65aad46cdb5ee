"""Networks of TDC-λ: SB3's actors, and quantile critics that are evaluated together."""

import math
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor as TanhGaussianActor
from stable_baselines3.td3.policies import Actor as DeterministicActor
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from sb3_tdc.common.checks import check_integer
from sb3_tdc.common.layers import StackedLinear, are_in_mode


class QuantileCritic(ContinuousCritic):
    """
    C critics, stacked layer by layer, each of which predicts the return as N quantiles (Eq. 3).

    Features are extracted and shared as in ``ContinuousCritic``. The critics share an activation with
    parameters (``nn.PReLU``).

    :param n_quantiles: N, quantiles per critic, at least 1
    :param n_critics: C, at least 1
    :raises ValueError: if either is below 1
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
        n_quantiles: int = 64,
        n_critics: int = 2,
        share_features_extractor: bool = True,
    ):
        n_quantiles = check_integer("n_quantiles", n_quantiles, minimum=1)
        n_critics = check_integer("n_critics", n_critics, minimum=1)
        super().__init__(
            observation_space,
            action_space,
            net_arch,
            features_extractor,
            features_dim,
            activation_fn,
            normalize_images,
            n_critics=0,  # the scalar networks of the parent are not built
            share_features_extractor=share_features_extractor,
        )
        self.n_critics = n_critics
        self.n_quantiles = n_quantiles
        layers: list[nn.Module] = []
        in_features = features_dim + get_action_dim(action_space)
        for width in net_arch:
            layers += [StackedLinear(n_critics, in_features, width), activation_fn()]
            in_features = width
        self.layers = nn.ModuleList([*layers, StackedLinear(n_critics, in_features, n_quantiles)])

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:  # type: ignore[override]
        """
        Return the quantiles of every critic (Eq. 3).

        :param obs: (B, ...) observations
        :param actions: (B, A) actions in [-1, 1]
        :return: (B, C, N)
        """
        # A features extractor shared with the actor learns from the actor's loss only
        with th.set_grad_enabled(th.is_grad_enabled() and not self.share_features_extractor):
            features = self.extract_features(obs, self.features_extractor)
        hidden = th.cat([features, actions], dim=1)
        for layer in self.layers:
            hidden = layer(hidden)
        return hidden.transpose(0, 1)

    def q1_forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Return the value for the actor: the mean of the first critic's quantiles (Eq. 11).

        :param obs: (B, ...) observations
        :param actions: (B, A) actions in [-1, 1]
        :return: (B, 1)
        """
        with th.no_grad():
            features = self.extract_features(obs, self.features_extractor)
        hidden = th.cat([features, actions], dim=1)
        for layer in self.layers:
            hidden = layer.forward_first(hidden) if isinstance(layer, StackedLinear) else layer(hidden)
        return hidden.mean(dim=1, keepdim=True)


# SB3's limits of log σ, and the ε that its tanh-Gaussian density adds to 1 − a²; compiled code has them as constants
LOG_STD_MIN, LOG_STD_MAX, TANH_EPSILON = -20.0, 2.0, 1e-6
# The constant in the log density of a normal distribution
LOG_SQRT_2_PI = 0.5 * math.log(2 * math.pi)


class TanhGaussian(SquashedDiagGaussianDistribution):
    """SB3's distribution, except that copies omit the last sample, which may hold an autograd graph."""

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "distribution": None, "gaussian_actions": None}


class TDCPolicy(TD3Policy):
    """
    Policy class (actor, quantile critics and the targets of both) for TDC-λ.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: Hidden layers, ``[256, 256]`` by default, or ``dict(pi=[...], qf=[...])``
    :param activation_fn: Activation function
    :param features_extractor_class: Features extractor to use
    :param features_extractor_kwargs: Keyword arguments to pass to the features extractor
    :param normalize_images: Whether to divide images by 255
    :param optimizer_class: The optimizer, ``th.optim.Adam`` by default (in its fused implementation)
    :param optimizer_kwargs: Additional keyword arguments for the optimizer, without the learning rate
    :param n_critics: Number of critics C
    :param share_features_extractor: Whether the actor and the critics share one features extractor
    :param n_quantiles: Quantiles per critic N_q
    :param stochastic_actor: ζ: a tanh-Gaussian head (True) or a deterministic one (False)
    """

    actor: DeterministicActor | TanhGaussianActor  # type: ignore[assignment]
    actor_target: DeterministicActor | TanhGaussianActor  # type: ignore[assignment]
    critic: QuantileCritic
    critic_target: QuantileCritic

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        features_extractor_class: type[BaseFeaturesExtractor] = FlattenExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        n_critics: int = 2,
        share_features_extractor: bool = False,
        n_quantiles: int = 64,
        stochastic_actor: bool = False,
    ):
        # Set before the call of TD3Policy's constructor, which builds the networks
        self.n_quantiles = n_quantiles
        self.stochastic_actor = stochastic_actor
        if optimizer_kwargs is None and optimizer_class is th.optim.Adam:
            optimizer_kwargs = {"fused": True}
        if net_arch is None:
            net_arch = [256, 256]
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch if isinstance(net_arch, dict) else list(net_arch),  # SB3 refuses a tuple
            activation_fn,
            features_extractor_class,
            features_extractor_kwargs,
            normalize_images,
            optimizer_class,
            optimizer_kwargs,
            n_critics,
            share_features_extractor,
        )

    def make_actor(  # type: ignore[override]
        self, features_extractor: BaseFeaturesExtractor | None = None
    ) -> DeterministicActor | TanhGaussianActor:
        actor_kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        if not self.stochastic_actor:
            return DeterministicActor(**actor_kwargs).to(self.device)
        actor = TanhGaussianActor(**actor_kwargs)
        actor.action_dist = TanhGaussian(get_action_dim(self.action_space))  # type: ignore[assignment]
        return actor.to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> QuantileCritic:
        critic_kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return QuantileCritic(**critic_kwargs, n_quantiles=self.n_quantiles).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(n_quantiles=self.n_quantiles, stochastic_actor=self.stochastic_actor)
        return data

    def set_training_mode(self, mode: bool) -> None:
        # SB3 calls this at every step; setting the mode of all modules would cost more than the actor's forward pass
        if self.training != mode or not are_in_mode((self.actor, self.critic), mode):
            super().set_training_mode(mode)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        # The mean action for both heads, whatever `deterministic` says (Eq. 15 and 19)
        return self.actor._predict(observation, deterministic=True)


MlpPolicy = TDCPolicy


class CnnPolicy(TDCPolicy):
    """Policy with ``NatureCNN`` features; the same parameters as :class:`TDCPolicy`, by keyword."""

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        features_extractor_class: type[BaseFeaturesExtractor] = NatureCNN,
        **kwargs: Any,
    ):
        kwargs["features_extractor_class"] = features_extractor_class
        super().__init__(observation_space, action_space, lr_schedule, **kwargs)


class MultiInputPolicy(TDCPolicy):
    """Policy for ``Dict`` observations; the same parameters as :class:`TDCPolicy`, by keyword."""

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        features_extractor_class: type[BaseFeaturesExtractor] = CombinedExtractor,
        **kwargs: Any,
    ):
        kwargs["features_extractor_class"] = features_extractor_class
        super().__init__(observation_space, action_space, lr_schedule, **kwargs)
