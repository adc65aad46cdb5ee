"""λ by calibration: returns of training episodes against the first critic's predictions (ACC, Dorka et al. 2021)."""

import copy
import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_tdc.common.returns import discounted_returns

# The largest λ of a calibration: beyond, the wider critic is selected nearly everywhere
MAX_LAM = 10.0
# η, the largest change of λ at once
RATE = 0.1
# The weight of the newest error in the moving average of their size
SCALE_WEIGHT = 0.05
# Steps whose returns are awaited, and updates, between two changes of λ
PERIOD = 1_000
# Steps of an episode between those whose values are predicted: neighbours tell the same
EVERY = 10
# Of more environments, so many are followed
MAX_FOLLOWED = 16
# The longest horizon, 1/(1 − γ), for which a calibration waits in the beginning
_MAX_HORIZON = 1_000


def initial_lam(lam: str) -> float:
    """
    Return where a calibrated λ begins.

    :param lam: "auto" (from 1), or "auto_" and a number
    :raises ValueError: for any other text
    """
    start = re.fullmatch(r"auto(?:_(\d{1,9}(?:\.\d{1,9})?))?", lam)
    if start and (value := float(start[1] or 1.0)) <= MAX_LAM:
        return value
    raise ValueError(
        f'lam must be a finite number of at least 0.0, a schedule, "auto", or "auto_" and a number up to {MAX_LAM:g} '
        f'(as in "auto_0.5"), got {lam!r}'
    )


def calibrate(lam: float, scale: float, errors: np.ndarray, least: float = 0.0) -> tuple[float, float]:
    """
    Move λ towards values that are right on average: up after underestimation, down after overestimation.

    λ ← clip(λ + η·clip(mean(G − Q₁)/scale, −1, 1), least, λ_max), where scale is a moving average of |G − Q₁|, so that
    the scale of rewards does not matter.

    :param lam: λ
    :param scale: 0 before the first errors
    :param errors: G − Q₁
    :return: λ and scale
    """
    size = float(np.abs(errors).mean())
    scale = scale + SCALE_WEIGHT * (size - scale) if scale > 0 else size
    share = float(np.clip(errors.mean() / scale, -1, 1)) if scale > 0 else 0.0
    return float(np.clip(lam + RATE * share, least, MAX_LAM)), scale


def updates_before(tau: float, gamma: float) -> float:
    """
    Return after how many updates a calibration begins: 1/(τ·(1 − γ)).

    Values grow from those of new networks to their size over as many: a target takes about 1/τ updates to follow, and
    the values of 1/(1 − γ) steps follow one another. That they are too small until then is not λ's doing.
    """
    horizon = min(1 / (1 - gamma), _MAX_HORIZON) if gamma < 1 else _MAX_HORIZON
    return horizon / tau if tau > 0 else math.inf


class PendingEpisode:
    """The rewards of an episode under way, and every ``EVERY``-th observation and action."""

    def __init__(self) -> None:
        self.rewards: list[float] = []
        self.observations: list[Any] = []
        self.actions: list[np.ndarray] = []

    def add(self, observation: Any, action: np.ndarray, reward: float) -> None:
        """
        Add a step.

        :param observation: as the policy saw it, without a batch axis
        :param action: in [-1, 1]
        :param reward: as the environment gave it
        """
        if len(self.rewards) % EVERY == 0:
            self.observations.append(copy.deepcopy(observation))
            self.actions.append(action.copy())
        self.rewards.append(reward)

    def returns(self, rewards: np.ndarray, gamma: float, following: float) -> np.ndarray:
        """
        Return the discounted returns of the steps that were looked at.

        :param rewards: those of the episode, in the critics' units
        :param following: the value of what comes after the last step; 0 where the episode ended by itself
        """
        return discounted_returns(rewards, gamma, following)[::EVERY]


class Calibration:
    """
    The episodes under way, and the errors of the ended ones since λ was changed.

    :ivar timestep: of the last step that was followed
    :ivar last_update: count of gradient steps when λ was changed
    """

    def __init__(self, n_updates: int = 0) -> None:
        self.episodes: dict[int, PendingEpisode] = {}
        self.errors: list[np.ndarray] = []
        self.n_steps = 0
        self.last_update = n_updates
        self.timestep: int | None = None

    def begin_episodes(self, n_envs: int) -> None:
        """Forget the episodes under way. Of many environments, which may explore differently, some are followed."""
        followed = np.linspace(0, n_envs - 1, min(n_envs, MAX_FOLLOWED)).round().astype(int)
        self.episodes = {int(i): PendingEpisode() for i in followed}

    def end_episode(self, env: int, errors: np.ndarray | None) -> None:
        """
        Begin the next episode of an environment.

        :param errors: G − Q₁ of the ended one, where it counts
        """
        if errors is not None:
            self.errors.append(errors)
            self.n_steps += len(self.episodes[env].rewards)
        self.episodes[env] = PendingEpisode()

    def take_errors(self, n_updates: int) -> np.ndarray | None:
        """
        Return the errors with which λ is to be changed now, if it is.

        :param n_updates: count of gradient steps
        """
        if self.n_steps < PERIOD or n_updates - self.last_update < PERIOD:
            return None
        errors = np.concatenate(self.errors)
        self.errors, self.n_steps, self.last_update = [], 0, n_updates
        return errors


def stack_observations(observations: Sequence[Any]) -> Any:
    """Return a batch of observations, which are arrays or dicts of arrays."""
    if isinstance(observations[0], dict):
        return {key: np.stack([one[key] for one in observations]) for key in observations[0]}
    return np.stack(observations)
