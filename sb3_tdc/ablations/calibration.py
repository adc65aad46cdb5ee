"""
TDC that calibrates λ by comparing the returns of training episodes with the first critic's predictions.

It follows ACC (Dorka et al. 2021); docs/lambda.md has the equations and the findings.
"""

import math
from typing import Any, ClassVar

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback

from sb3_tdc.common.checks import Limits
from sb3_tdc.common.saved_fields import SavedField, number
from sb3_tdc.critics.episodes import EVERY, Steps, predict_quantiles
from sb3_tdc.critics.returns import discounted_returns
from sb3_tdc.tdc import TDC

# The largest λ of a calibration: beyond it, the wider critic is selected nearly everywhere
MAX_LAM = 10.0
# η, the largest change of λ in one calibration step
RATE = 0.1
# The weight of the newest errors in the moving average of the errors' size
SCALE_WEIGHT = 0.05
# The smallest number of steps of ended episodes, and of updates, between two changes of λ
PERIOD = 1_000
# The largest number of environments whose episodes are followed
MAX_FOLLOWED = 16
# The longest horizon, 1/(1 − γ) in steps, that a calibration waits for before it begins
_MAX_HORIZON = 1_000


def calibrate(lam: float, scale: float, errors: np.ndarray, least: float) -> tuple[float, float]:
    """
    Move λ so that predicted values become right on average: up after underestimation, down after overestimation.

    λ ← clip(λ + η·clip(mean(G − Q₁)/scale, −1, 1), least, λ_max), where scale is a moving average of |G − Q₁|, so that
    the scale of rewards does not matter.

    :param lam: λ
    :param scale: the moving average so far; 0 before the first errors
    :param errors: G − Q₁
    :param least: the smallest λ
    :return: the new λ and the new scale
    """
    size = float(np.abs(errors).mean())
    scale = scale + SCALE_WEIGHT * (size - scale) if scale > 0 else size
    share = float(np.clip(errors.mean() / scale, -1, 1)) if scale > 0 else 0.0
    return float(np.clip(lam + RATE * share, least, MAX_LAM)), scale


def updates_before(tau: float, gamma: float) -> float:
    """
    Return the number of updates after which a calibration begins: 1/(τ·(1 − γ)); infinity if τ is 0.

    The values of new networks take about this many updates to grow to their full size: a target follows in about 1/τ
    updates, and values depend on one another over 1/(1 − γ) steps, here at most ``_MAX_HORIZON``. Until then they are
    too small, but not because of λ.
    """
    horizon = min(1 / (1 - gamma), _MAX_HORIZON) if gamma < 1 else _MAX_HORIZON
    return horizon / tau if tau > 0 else math.inf


class Calibration:
    """
    The episodes in progress, and the errors of the episodes that ended since λ was last changed.

    :ivar timestep: count of timesteps at the last step that was followed
    :ivar last_update: count of gradient steps when λ was last changed
    """

    def __init__(self, n_updates: int = 0) -> None:
        self.episodes: dict[int, Steps] = {}
        self.errors: list[np.ndarray] = []
        self.n_steps = 0
        self.last_update = n_updates
        self.timestep: int | None = None

    def begin_episodes(self, n_envs: int) -> None:
        """Drop the episodes in progress. Follow a spread of many environments, which may explore differently."""
        followed = np.linspace(0, n_envs - 1, min(n_envs, MAX_FOLLOWED)).round().astype(int)
        self.episodes = {int(i): Steps(EVERY) for i in followed}

    def end_episode(self, env: int, errors: np.ndarray | None) -> None:
        """
        Begin the next episode of an environment.

        :param errors: G − Q₁ of the ended episode, or None if it does not count
        """
        if errors is not None:
            self.errors.append(errors)
            self.n_steps += len(self.episodes[env].rewards)
        self.episodes[env] = Steps(EVERY)

    def take_errors(self, n_updates: int) -> np.ndarray | None:
        """
        Return the errors collected so far and begin again, or None if λ is not to be changed yet.

        :param n_updates: count of gradient steps
        """
        if self.n_steps < PERIOD or n_updates - self.last_update < PERIOD:
            return None
        errors = np.concatenate(self.errors)
        self.errors, self.n_steps, self.last_update = [], 0, n_updates
        return errors


class CalibratedTDC(TDC):
    """
    TDC whose λ begins at ``lam``, rises after underestimation and falls after overestimation.

    A ``lam`` that differs from the one at which the calibration began starts it again.

    :param args: arguments of TDC
    :param kwargs: arguments of TDC; ``lam`` is a number from 0 to 10
    """

    limits: ClassVar[Limits] = {**TDC.limits, "lam": (0.0, MAX_LAM)}
    saved_fields: ClassVar[dict[str, SavedField]] = {
        "_calibrated": SavedField(number(0.0, MAX_LAM), is_required=False),
        "_calibrated_from": SavedField(number(0.0, MAX_LAM), is_required=False),
        "_error_scale": SavedField(number(0.0), is_required=False),
    }
    captured_attributes: ClassVar[tuple[str, ...]] = (*TDC.captured_attributes, "_calibration")
    least: ClassVar[float] = 0.0
    color: ClassVar[str | None] = "#000000"
    # Values before the first calibration
    _calibrated: float = 0.0
    _calibrated_from: float | None = None
    _error_scale: float = 0.0

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if callable(self.lam):
            raise ValueError("lam must be a number, at which the calibration begins, got a schedule")
        self._check_limits("lam")

    def _setup_model(self) -> None:
        super()._setup_model()
        self._calibration = Calibration(self._n_updates)

    @property
    def calibrated(self) -> float:
        """Return the calibrated number, which is λ unless it is negative."""
        return self._calibrated if self._calibrated_from == self.lam else float(self.lam)  # type: ignore[arg-type]

    @property
    def error_scale(self) -> float:
        """Return the moving average of |G − Q₁|; 0 before the first errors."""
        return self._error_scale if self._calibrated_from == self.lam else 0.0

    def scheduled(self, name: str, progress_remaining: float | None = None) -> float:
        if name == "lam" and progress_remaining is None:
            return max(self.calibrated, 0.0)
        return super().scheduled(name, progress_remaining)

    # ---------------------------------------------------------------- episodes

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        observation, timestep = self._last_obs, self.num_timesteps
        prepared = super()._setup_learn(*args, **kwargs)
        # If a callback stopped the last rollout, SB3 did not store its last step, so the episodes are incomplete
        if self._last_obs is not observation or timestep != self._calibration.timestep:
            self.forget_episodes()
        return prepared

    def forget_episodes(self) -> None:
        self._calibration.begin_episodes(self.n_envs)

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        observations = self._last_obs
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)  # all values are finite
        self._follow_episodes(observations, buffer_action, reward, dones, infos)

    def _follow_episodes(
        self, observations: Any, action: np.ndarray, reward: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]
    ) -> None:
        """Add a step to the episodes, and change λ if enough steps of ended episodes have been collected."""
        normalization, calibration = self._vec_normalize_env, self._calibration
        rewards = reward if normalization is None else normalization.get_original_reward()
        for i, episode in calibration.episodes.items():
            one = {k: v[i] for k, v in observations.items()} if isinstance(observations, dict) else observations[i]
            episode.add(one, action[i], float(rewards[i]))
            if dones[i]:
                counts = self._n_updates >= updates_before(self.tau, self.gamma)
                calibration.end_episode(i, self._prediction_errors(episode, infos[i]) if counts else None)
        calibration.timestep = self.num_timesteps
        errors = calibration.take_errors(self._n_updates)
        if errors is not None:
            self._calibrate(errors)

    def _prediction_errors(self, episode: Steps, info: dict[str, Any]) -> np.ndarray:
        """Return G − Q₁ at the kept steps of an ended episode; after a time limit, G continues with Q₁."""
        rewards = np.asarray(episode.rewards)
        if self._vec_normalize_env is not None:  # the rewards from which the critics learn
            rewards = self._vec_normalize_env.normalize_reward(rewards)
        following = 0.0
        if info.get("TimeLimit.truncated", False) and getattr(self.replay_buffer, "handle_timeout_termination", True):
            last = info["terminal_observation"]
            action, _ = self.predict(last, deterministic=True)
            following = float(self._first_values([last], action[None])[0])
        returns = discounted_returns(rewards, self.gamma, following)[:: episode.every]
        actions = self.policy.unscale_action(np.stack(episode.actions))
        return returns - self._first_values(episode.observations, actions)

    def _first_values(self, observations: list[Any], actions: np.ndarray) -> np.ndarray:
        """Return Q₁, (T,), of observations as the policy saw them and actions as given to the environment."""
        return predict_quantiles(self, observations, actions)[:, 0].mean(dim=1).numpy()

    def _calibrate(self, errors: np.ndarray) -> None:
        self._calibrated, self._error_scale = calibrate(self.calibrated, self.error_scale, errors, self.least)
        self._calibrated_from = float(self.lam)  # type: ignore[arg-type]
        self.diagnose(lam_error=float(errors.mean()), lam_scale=self._error_scale)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_calibration"]
