"""TD3, SAC and TDC with an advisory board. The algorithms are unchanged, except for the choice of actions."""

import inspect
import math
from typing import Any, ClassVar

import numpy as np
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy

from sb3_tdc.advb import policies
from sb3_tdc.common.checks import OFF_POLICY_LIMITS, Limits, check_observation_space, check_within
from sb3_tdc.common.noise import NoisyOffPolicyAlgorithm
from sb3_tdc.common.saved_fields import SavedField, integer
from sb3_tdc.common.signatures import constructor_parameters
from sb3_tdc.tdc import TDC


class Advised(NoisyOffPolicyAlgorithm):
    """
    An off-policy algorithm whose policy has a board. :class:`~sb3_tdc.advb.BoardCallback` fills it during training.

    :param formation_period: episodes before the board also acts in training; from then on, SAC explores by
        ``action_noise`` alone
    :param args: arguments of the algorithm
    :param kwargs: arguments of the algorithm; ``policy_kwargs`` may hold ``n_members`` (10)
    """

    limits: ClassVar[Limits] = {**OFF_POLICY_LIMITS, "formation_period": (0, math.inf), "n_members": (1, 256)}
    saved_fields: ClassVar[dict[str, SavedField]] = {
        "formation_period": SavedField(integer(0)),
        "policy_kwargs.n_members": SavedField(integer(1, 256), is_required=False),
    }

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        # Make ``help`` and notebooks show the arguments of the algorithm, not *args and **kwargs
        parameters = constructor_parameters(cls)
        parameters.pop("self", None)
        in_order = sorted(parameters.values(), key=lambda p: (p.kind, p.default is not p.empty))
        cls.__signature__ = inspect.Signature(in_order)  # type: ignore[attr-defined]

    def __init__(self, *args: Any, formation_period: int = 10_000, **kwargs: Any):
        self.formation_period = formation_period
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        check_observation_space(self.observation_space)
        self.formation_period = int(check_within(self.limits, "formation_period", self.formation_period))
        check_within(self.limits, "n_members", self.policy_kwargs.get("n_members", 10), "policy_kwargs['n_members']")
        super()._setup_model()

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        policy: Any = self.policy
        policy.board_explores = self._episode_num >= self.formation_period
        try:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        finally:
            policy.board_explores = False


class AdvBTD3(Advised, TD3):
    """
    TD3 with a cooperative advisory board (AdvB-TD3, Osman et al.).

    :param args: arguments of SB3's TD3
    :param kwargs: arguments of SB3's TD3; ``formation_period``: episodes before the board also acts in training
    """

    color: ClassVar[str | None] = "#8C564B"
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": policies.TD3MlpPolicy,
        "CnnPolicy": policies.TD3CnnPolicy,
        "MultiInputPolicy": policies.TD3MultiInputPolicy,
    }


class AdvBSAC(Advised, SAC):
    """
    SAC with the board of AdvB-TD3, since nothing public describes AdvB-SAC. Its members propose their mean actions.

    :param args: arguments of SB3's SAC
    :param kwargs: arguments of SB3's SAC; ``formation_period``: episodes before the board also acts in training
    """

    color: ClassVar[str | None] = "#17BECF"
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": policies.SACMlpPolicy,
        "CnnPolicy": policies.SACCnnPolicy,
        "MultiInputPolicy": policies.SACMultiInputPolicy,
    }


class AdvBTDC(Advised, TDC):
    """
    TDC with the board of AdvB-TD3, whose members' mean actions are scored by min_i (μ_i − λσ_i) of TDC's critics.

    Its policy is a subclass of TDC's, so only the readable update is used.

    :param args: arguments of TDC
    :param kwargs: arguments of TDC; ``formation_period``: episodes before the board also acts in training
    """

    color: ClassVar[str | None] = "#9467BD"
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": policies.TDCMlpPolicy,
        "CnnPolicy": policies.TDCCnnPolicy,
        "MultiInputPolicy": policies.TDCMultiInputPolicy,
    }
    limits: ClassVar[Limits] = {**TDC.limits, **Advised.limits}

    def _setup_model(self) -> None:
        super()._setup_model()
        self._advise_by_current_lam()

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """
        Train as TDC does; the board then scores with the same λ.

        :param gradient_steps: number of updates
        :param batch_size: B, transitions per update
        """
        super().train(gradient_steps, batch_size)
        self._advise_by_current_lam()

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Predict as TDC does; the board scores with the current λ."""
        self._advise_by_current_lam()
        return super().predict(observation, state, episode_start, deterministic)

    def _advise_by_current_lam(self) -> None:
        self.policy.lam.fill_(self.scheduled("lam"))  # type: ignore[operator]
