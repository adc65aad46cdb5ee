"""Policies of TD3, SAC and TDC with a board among their weights, so that it is saved, resumed and loaded with them."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac import policies as sac
from stable_baselines3.td3 import policies as td3

from sb3_tdc.advb.board import Board
from sb3_tdc.tdc import policies as tdc
from sb3_tdc.tdc.quantiles import mean_and_std


class AdvisedPolicy(BasePolicy):
    """
    Base class that adds a board to a policy with an actor and critics: the board chooses the deterministic actions.

    :param n_members: seats of the board
    :param args: arguments of the policy
    :param kwargs: arguments of the policy
    """

    def __init__(self, *args: Any, n_members: int = 10, **kwargs: Any):
        self.n_members = n_members
        self.actor_decides_alone = False
        self.board_explores = False
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)  # type: ignore[misc]
        with th.random.fork_rng(devices=[]):  # the board draws no random numbers of the training
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


class TD3MlpPolicy(AdvisedPolicy, td3.MlpPolicy):
    """SB3's policy of TD3 with a board."""


class TD3CnnPolicy(AdvisedPolicy, td3.CnnPolicy):
    """SB3's policy of TD3 for images, with a board."""


class TD3MultiInputPolicy(AdvisedPolicy, td3.MultiInputPolicy):
    """SB3's policy of TD3 for ``Dict`` observations, with a board."""


class SACMlpPolicy(AdvisedPolicy, sac.MlpPolicy):
    """SB3's policy of SAC with a board."""


class SACCnnPolicy(AdvisedPolicy, sac.CnnPolicy):
    """SB3's policy of SAC for images, with a board."""


class SACMultiInputPolicy(AdvisedPolicy, sac.MultiInputPolicy):
    """SB3's policy of SAC for ``Dict`` observations, with a board."""


class RiskAdvisedPolicy(AdvisedPolicy):
    """A policy whose board is scored by quantile critics; ``lam`` is λ, which the algorithm keeps up to date."""

    lam: th.Tensor

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.register_buffer("lam", th.zeros(()))

    def score(self, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """
        Return min_i (μ_i − λσ_i) over the quantiles at (s, a).

        :param obs: (B, ...)
        :param actions: (B, A), in [-1, 1]
        :return: (B,)
        """
        mean, std = mean_and_std(self.critic(obs, actions))  # type: ignore[operator]
        return (mean - self.lam * std).amin(dim=1)


class TDCMlpPolicy(RiskAdvisedPolicy, tdc.MlpPolicy):
    """The policy of TDC with a board."""


class TDCCnnPolicy(RiskAdvisedPolicy, tdc.CnnPolicy):
    """The policy of TDC for images, with a board."""


class TDCMultiInputPolicy(RiskAdvisedPolicy, tdc.MultiInputPolicy):
    """The policy of TDC for ``Dict`` observations, with a board."""
