"""The policies of SB3's TD3 and SAC, with a board in their weights: it is saved, restored and opened with them."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, NatureCNN
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy

from sb3_tdc.advb.board import Board


class AdvisedPolicy(BasePolicy):
    """
    What a board adds to a policy with an actor and critics: deterministic actions are the board's.

    :param n_members: seats of the board
    :param args: those of the policy
    :param kwargs: those of the policy
    """

    def __init__(self, *args: Any, n_members: int = 10, **kwargs: Any):
        self.n_members = n_members
        self.actor_decides_alone = False
        self.board_explores = False
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)  # type: ignore[misc]
        self.board = Board([self.make_actor() for _ in range(self.n_members)])  # type: ignore[operator]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "n_members": self.n_members}

    @contextmanager
    def actor_alone(self) -> Iterator[None]:
        """Let the actor act without its board."""
        before, self.actor_decides_alone = self.actor_decides_alone, True
        try:
            yield
        finally:
            self.actor_decides_alone = before

    def score(self, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """
        Return min_i Q_i(s, a).

        :param obs: (B, ...)
        :param actions: (B, A), in [-1, 1]
        :return: (B,)
        """
        return th.cat(self.critic(obs, actions), dim=1).amin(dim=1)  # type: ignore[operator]

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        advised = (deterministic or self.board_explores) and len(self.board) > 0
        if advised and not self.actor_decides_alone:
            return self.board.cooperative_actions(observation, self.score)
        return super()._predict(observation, deterministic)  # type: ignore[safe-super]


class TD3MlpPolicy(AdvisedPolicy, TD3Policy):
    """SB3's TD3 policy with a board."""


class SACMlpPolicy(AdvisedPolicy, SACPolicy):
    """SB3's SAC policy with a board."""


class TD3CnnPolicy(TD3MlpPolicy):
    """:class:`TD3MlpPolicy` with ``NatureCNN`` features; the same parameters, by keyword."""

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


class TD3MultiInputPolicy(TD3MlpPolicy):
    """:class:`TD3MlpPolicy` for ``Dict`` observations; the same parameters, by keyword."""

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


class SACCnnPolicy(SACMlpPolicy):
    """:class:`SACMlpPolicy` with ``NatureCNN`` features; the same parameters, by keyword."""

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


class SACMultiInputPolicy(SACMlpPolicy):
    """:class:`SACMlpPolicy` for ``Dict`` observations; the same parameters, by keyword."""

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
