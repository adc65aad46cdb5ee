"""
Predictions of TDC's critics, compared with the returns that follow.

Shapes: ``T`` steps of an episode, ``C`` critics, ``N`` quantiles. The critics predict at the state and the mean action
that is played.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_tdc.common.playing import play_steps
from sb3_tdc.critics.returns import discounted_returns, known_steps
from sb3_tdc.tdc import TDC
from sb3_tdc.tdc.quantiles import mean_and_std, quantile_midpoints, select_critic


def observed_frequency(quantiles: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """
    Return how often the return stayed at or below each predicted quantile.

    For a calibrated critic, this frequency is the level of the quantile.

    :param quantiles: (T, N)
    :param returns: (T,)
    :return: (N,), between 0 and 1
    """
    return (returns[:, None] <= quantiles).mean(axis=0)


@dataclass(frozen=True)
class Episode:
    """
    One episode and the critics' predictions along it.

    :param steps: (M,), the steps at which the critics predicted, in increasing order
    :param quantiles: (M, C, N), predicted returns
    :param selected: (M,), the critic that the target would select (Eq. 5)
    :param returns: (M,), realised discounted returns; NaN where too much of the return was not seen
    """

    steps: np.ndarray
    quantiles: np.ndarray
    selected: np.ndarray
    returns: np.ndarray

    @property
    def means(self) -> np.ndarray:
        """Return (M, C), predicted means."""
        return self.quantiles.mean(axis=2)

    @property
    def stds(self) -> np.ndarray:
        """Return (M, C), population standard deviations (Eq. 4)."""
        return self.quantiles.std(axis=2)

    @property
    def overestimation(self) -> np.ndarray:
        """Return (M, C), predicted mean − realised return; NaN where the return is not known."""
        return self.means - self.returns[:, None]

    @property
    def frequencies(self) -> np.ndarray:
        """Return (C, N), see :func:`observed_frequency`; NaN if no return is known."""
        known = np.isfinite(self.returns)
        if not known.any():
            return np.full(self.quantiles.shape[1:], np.nan)
        critics = self.quantiles[known].transpose(1, 0, 2)
        return np.stack([observed_frequency(quantiles, self.returns[known]) for quantiles in critics])


def rank_correlation(x: np.ndarray, y: np.ndarray) -> float:
    """
    Return Spearman's rank correlation.

    :param x: (T,)
    :param y: (T,)
    :return: between −1 and 1; NaN if T < 3, or if all of ``x`` or all of ``y`` are equal
    """
    if len(x) < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return float("nan")
    matrix: Any = np.corrcoef(np.stack([_ranks(x), _ranks(y)]))
    return float(matrix[0, 1])


def _ranks(values: np.ndarray) -> np.ndarray:
    """Return ranks; equal values share the mean of their ranks."""
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - (counts - 1) / 2)[places]


def pool(episodes: Sequence[Episode]) -> Episode:
    """Return all steps with a known return, as if they belonged to one episode."""
    known = [np.isfinite(episode.returns) for episode in episodes]
    names = [field.name for field in fields(Episode)]
    parts = {n: [getattr(e, n)[k] for e, k in zip(episodes, known, strict=True)] for n in names}
    return Episode(**{name: np.concatenate(arrays) for name, arrays in parts.items()})


def summarise(episodes: Sequence[Episode]) -> dict[str, float]:
    """
    Summarise episodes with the same weight for every step: a short episode must not count as much as a long one.

    :return: ``overestimation`` (mean over steps and critics, in units of the critics' return),
        ``calibration_error`` (mean over levels and critics of |observed − nominal|, between 0 and 0.5 or so),
        ``std_error_correlation`` and ``std_scatter_correlation`` (rank correlations of σ with the error, and with the
        error without bias, see :func:`spread_and_errors`; means over critics); empty if no return is known
    """
    pooled = pool(episodes)
    if not len(pooled.returns):
        return {}
    levels = quantile_midpoints(pooled.frequencies.shape[1]).numpy()
    summary = {
        "overestimation": float(pooled.overestimation.mean()),
        "calibration_error": float(np.abs(pooled.frequencies - levels).mean()),
    }
    std, error, scatter = spread_and_errors(pooled)
    for name, errors in (("std_error_correlation", error), ("std_scatter_correlation", scatter)):
        correlation = np.mean([rank_correlation(*pair) for pair in zip(std.T, errors.T, strict=True)])
        if np.isfinite(correlation):
            summary[name] = float(correlation)
    return summary


def spread_and_errors(pooled: Episode) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Return σ, |G − μ|, and |G − a − b·μ| for the line of best fit: the error without any bias that is linear in μ.

    A bias can hide the information in σ, or imitate it. The scatter around the line is what σ should predict.

    :param pooled: M steps with known returns
    :return: each (M, C)
    """
    means, returns = pooled.means - pooled.means.mean(axis=0), (pooled.returns - pooled.returns.mean())[:, None]
    squares = (means**2).sum(axis=0)
    slope = np.divide((means * returns).sum(axis=0), squares, out=np.zeros_like(squares), where=squares > 0)
    return pooled.stds, np.abs(pooled.overestimation), np.abs(returns - slope * means)


# The distance between the steps at which critics predict: neighbouring steps give nearly the same information
EVERY = 10


class Steps:
    """
    The rewards of an episode in progress, and the observations and actions of every few steps.

    :param every: keep the observation and the action of every ``every``-th step; at least 1
    """

    def __init__(self, every: int = 1):
        self.every = every
        self.start()

    def start(self) -> None:
        """Begin an episode."""
        self.rewards: list[float] = []
        self.observations: list[Any] = []
        self.actions: list[np.ndarray] = []

    def add(self, observation: Any, action: np.ndarray, reward: float) -> None:
        """
        Add a step.

        :param observation: without a batch axis, as the policy saw it
        :param action: (A,)
        :param reward: as the environment gave it
        """
        if len(self.rewards) % self.every == 0:
            self.observations.append(copy.deepcopy(observation))
            self.actions.append(action.copy())
        self.rewards.append(reward)


class Recording(Steps):
    """
    The steps of an episode in progress; at its end, the critics predict at all of them at once.

    :param model: the model whose critics, γ and λ are used
    :param every: predict at every ``every``-th step, at least 1; the rewards of all steps count
    :param normalization: converts the rewards to those that the critics were trained on; None if they already are
    :param time_limit: of the task, in steps, if play does not continue after it
        (:func:`~sb3_tdc.critics.returns.known_steps`)
    """

    def __init__(
        self, model: TDC, every: int = 1, normalization: VecNormalize | None = None, time_limit: int | None = None
    ):
        super().__init__(every)
        self.model, self.normalization, self.time_limit = model, normalization, time_limit

    def finish(self, terminated: bool, n_shown: int | None = None) -> Episode:
        """
        End the episode, and predict at its steps.

        :param terminated: whether the episode ended by itself
        :param n_shown: keep only the steps before this one; None keeps all
        """
        n_steps = len(self.rewards)
        rewards = np.asarray(self.rewards)
        if self.normalization is not None:
            rewards = self.normalization.normalize_reward(rewards)  # unchanged if it does not normalise rewards
        returns = discounted_returns(rewards, self.model.gamma)
        returns[known_steps(n_steps, terminated, self.model.gamma, self.time_limit) :] = np.nan
        steps = np.arange(0, n_steps, self.every)
        steps = steps[: np.searchsorted(steps, n_shown)] if n_shown is not None else steps
        quantiles = predict_quantiles(self.model, self.observations[: len(steps)], np.stack(self.actions[: len(steps)]))
        mean, std = mean_and_std(quantiles)
        selected = select_critic(mean, std, self.model.scheduled("lam"))
        return Episode(steps, quantiles.numpy().astype(float), selected.numpy(), returns[steps])


def predict_quantiles(
    model: TDC, observations: Sequence[Any], actions: np.ndarray, batch_size: int = 1024
) -> th.Tensor:
    """
    Predict the quantiles of all critics for observations and actions.

    :param observations: T of them, without a batch axis; arrays or dicts of arrays
    :param actions: (T, *shape of an action), as given to the environment
    :return: (T, C, N) quantiles of the critics, on the CPU
    """
    policy = model.policy
    policy.set_training_mode(False)
    predicted = []
    for begin in range(0, len(observations), batch_size):
        stacked = _stack(observations[begin : begin + batch_size])
        with th.no_grad():
            scaled = policy.scale_action(actions[begin : begin + batch_size])
            flat = th.as_tensor(scaled.reshape(len(scaled), -1), dtype=th.float32, device=model.device)
            predicted.append(policy.critic(policy.obs_to_tensor(stacked)[0], flat).cpu())
    return th.cat(predicted)


def _stack(observations: Sequence[Any]) -> Any:
    """Return a batch of observations, which are arrays or dicts of arrays."""
    if isinstance(observations[0], dict):
        return {key: np.stack([one[key] for one in observations]) for key in observations[0]}
    return np.stack(observations)


def record_episodes(model: TDC, env: VecEnv, n_episodes: int, limit: int | None = None) -> list[Episode]:
    """
    Record episodes in which the mean action is played in one environment.

    :param env: an environment whose rewards are those that the critics were trained on
    :param limit: keep only the steps before this one, in each episode; the rewards of the others still count
    """
    recording = Recording(model)
    episodes: list[Episode] = []
    if n_episodes < 1:
        return episodes
    for step in play_steps(model, env):
        seen = step.observation
        recording.add(
            {k: v[0] for k, v in seen.items()} if isinstance(seen, dict) else seen[0], step.action, step.reward
        )
        if step.done:
            episodes.append(recording.finish(not step.info.get("TimeLimit.truncated", False), limit))
            recording.start()
        if len(episodes) == n_episodes:
            break
    return episodes
