"""Networks of MEOW: one flow that is the policy, the soft Q-functions and the soft value functions at once."""

import math
from typing import Any, NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel, BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_tdc.common.layers import StackedLinear, are_in_mode
from sb3_tdc.meow.flow import ConditionalFlow, Swish


class SoftValues(NamedTuple):
    """
    Soft values for C reward shifts, divided by the temperature α.

    q: (B, C), values of the actions
    v: (B, C), values of the states
    """

    q: th.Tensor
    v: th.Tensor


class EnergyFlow(BaseModel):
    """
    A conditional flow with learnable reward shifts b_i(s): exact soft values without sampling.

    :param observation_space: Observation space
    :param action_space: Action space
    :param features_extractor: Network to extract features
    :param features_dim: Number of features
    :param normalize_images: Whether to divide images by 255
    :param shift_arch: Units of the hidden layers of the reward shifts
    :param n_shifts: Number of reward shifts C
    :param flow_kwargs: Keyword arguments of the flow
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        normalize_images: bool,
        shift_arch: list[int],
        n_shifts: int,
        flow_kwargs: dict[str, Any],
    ):
        super().__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        self.flow = ConditionalFlow(features_dim, get_action_dim(action_space), **flow_kwargs)
        layers: list[nn.Module] = []
        in_features = features_dim
        for width in shift_arch:
            layers += [StackedLinear(n_shifts, in_features, width), Swish(n_shifts, 1, width)]
            in_features = width
        self.shifts = nn.Sequential(*layers, StackedLinear(n_shifts, in_features, 1))
        for layer in self.shifts:
            if isinstance(layer, StackedLinear):
                nn.init.zeros_(layer.weight)

    def features(self, obs: PyTorchObs) -> th.Tensor:
        """
        Extract the features of observations.

        :param obs: (B, ...)
        :return: (B, D)
        """
        assert self.features_extractor is not None
        return self.extract_features(obs, self.features_extractor)

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> SoftValues:
        """
        Return the soft values of actions and states, divided by α: q_i − v_i = log π(a|s).

        :param obs: (B, ...) observations
        :param actions: (B, A) actions in [-1, 1]
        :return: −½ Σ (z/σ)² − log |det ∂a/∂z| + b_i, and the values of :meth:`values`
        """
        features = self.features(obs)
        shifts, log_std = self._shifts(features), self.flow.log_std(features)
        z, log_det = self.flow.inverse(actions, features)
        energy = -0.5 * (z * (-log_std).exp()).square().sum(dim=1) - log_det
        return SoftValues(energy.unsqueeze(1) + shifts, _log_normalizer(log_std) + shifts)

    def values(self, obs: PyTorchObs) -> th.Tensor:
        """
        Return the soft values of states, divided by α: log ∫ exp(Q_i/α) da in closed form.

        :param obs: (B, ...) observations
        :return: (B, C), Σ log σ + (A/2) log 2π + b_i
        """
        features = self.features(obs)
        return _log_normalizer(self.flow.log_std(features)) + self._shifts(features)

    def _shifts(self, features: th.Tensor) -> th.Tensor:
        return self.shifts(features).squeeze(2).T


def _log_normalizer(log_std: th.Tensor) -> th.Tensor:
    """Return (B, 1), the logs of the normalising constants of N(0, σ²), from (B, A), log σ."""
    return (log_std + 0.5 * math.log(2 * math.pi)).sum(dim=1, keepdim=True)


class MEOWPolicy(BasePolicy):
    """
    Policy class (the flow and its target) for MEOW.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: Units of the hidden layers of the couplings and of σ(s), ``[64, 64]`` by default
    :param features_extractor_class: Features extractor to use
    :param features_extractor_kwargs: Keyword arguments to pass to the features extractor
    :param normalize_images: Whether to divide images by 255
    :param optimizer_class: The optimizer, ``th.optim.Adam`` by default (in its fused implementation)
    :param optimizer_kwargs: Additional keyword arguments for the optimizer, without the learning rate
    :param shift_arch: Units of the hidden layers of the reward shifts, ``[256, 256]`` by default
    :param n_shifts: Number of reward shifts; the target takes the smallest value
    :param n_blocks: Blocks of two couplings
    :param dropout: Probability that a hidden unit of a coupling is dropped in training mode
    :param log_std_min: Lower limit of log σ(s) of the latent Gaussian
    :param log_std_max: Upper limit of log σ(s)
    """

    network: EnergyFlow
    network_target: EnergyFlow

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | None = None,
        features_extractor_class: type[BaseFeaturesExtractor] = FlattenExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        shift_arch: list[int] | None = None,
        n_shifts: int = 2,
        n_blocks: int = 2,
        dropout: float = 0.1,
        log_std_min: float = -5.0,
        log_std_max: float = -0.3,
    ):
        if optimizer_kwargs is None and optimizer_class is th.optim.Adam:
            optimizer_kwargs = {"fused": True}
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class,
            features_extractor_kwargs,
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=True,
        )
        self.net_arch = [64, 64] if net_arch is None else net_arch
        self.shift_arch = [256, 256] if shift_arch is None else shift_arch
        self.n_shifts = n_shifts
        self.flow_kwargs = {
            "n_blocks": n_blocks,
            "dropout": dropout,
            "log_std_min": log_std_min,
            "log_std_max": log_std_max,
        }
        self.network = self.make_network()
        self.network_target = self.make_network()
        self.network_target.load_state_dict(self.network.state_dict())
        self.network_target.set_training_mode(False)
        self.optimizer = self.optimizer_class(
            self.network.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )

    def make_network(self) -> EnergyFlow:
        """
        Build a flow with its own features extractor.

        :return: the flow
        """
        features_extractor = self.make_features_extractor()
        return EnergyFlow(
            self.observation_space,
            self.action_space,  # type: ignore[arg-type]
            features_extractor,
            features_extractor.features_dim,
            self.normalize_images,
            self.shift_arch,
            self.n_shifts,
            {"net_arch": self.net_arch, **self.flow_kwargs},
        ).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            lr_schedule=self._dummy_schedule,  # not needed in a copy that only predicts
            net_arch=self.net_arch,
            features_extractor_class=self.features_extractor_class,
            features_extractor_kwargs=self.features_extractor_kwargs,
            optimizer_class=self.optimizer_class,
            optimizer_kwargs=self.optimizer_kwargs,
            shift_arch=self.shift_arch,
            n_shifts=self.n_shifts,
            **self.flow_kwargs,
        )
        return data

    def set_training_mode(self, mode: bool) -> None:
        """Switch the mode of the flow, but never that of its target, which must not use dropout."""
        # SB3 calls this at every step; setting the mode of all modules would cost more than acting
        if self.training != mode or not are_in_mode((self.network,), mode):
            self.network.set_training_mode(mode)
            self.training = mode

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(obs, deterministic=deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        features = self.network.features(observation)
        return self.network.flow.mode(features) if deterministic else self.network.flow.sample(features)


MlpPolicy = MEOWPolicy


class CnnPolicy(MEOWPolicy):
    """Policy with ``NatureCNN`` features; the same parameters as :class:`MEOWPolicy`, by keyword."""

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


class MultiInputPolicy(MEOWPolicy):
    """Policy for ``Dict`` observations; the same parameters as :class:`MEOWPolicy`, by keyword."""

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
