"""
What the critics of TDC predict, against the returns that follow.

Shapes: ``T`` steps of an episode, ``C`` critics, ``N`` quantiles. Predictions are of the critics at the state and the
mean action that is played.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_tdc.common.returns import discounted_returns, known_steps
from sb3_tdc.tdc import TDC
from sb3_tdc.tdc.quantiles import mean_and_std, quantile_midpoints, select_critic


def observed_frequency(quantiles: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """
    How often the return stayed at or below each predicted quantile: of a calibrated critic, as often as its level says.

    :param quantiles: (T, N)
    :param returns: (T,)
    :return: (N,), between 0 and 1
    """
    return (returns[:, None] <= quantiles).mean(axis=0)


@dataclass(frozen=True)
class Episode:
    """
    One episode and what was predicted on its way.

    :param steps: (M,), those that were looked at, in increasing order
    :param quantiles: (M, C, N), predicted returns
    :param selected: (M,), the critic that the target would take (Eq. 5)
    :param returns: (M,), realised discounted returns; NaN where too much of it was not seen
    """

    steps: np.ndarray
    quantiles: np.ndarray
    selected: np.ndarray
    returns: np.ndarray

    @property
    def means(self) -> np.ndarray:
        """(M, C)"""
        return self.quantiles.mean(axis=2)

    @property
    def stds(self) -> np.ndarray:
        """(M, C), population standard deviations (Eq. 4)"""
        return self.quantiles.std(axis=2)

    @property
    def overestimation(self) -> np.ndarray:
        """(M, C), predicted mean − realised return; NaN where that is not known"""
        return self.means - self.returns[:, None]

    @property
    def frequencies(self) -> np.ndarray:
        """(C, N), see :func:`observed_frequency`; NaN if no return is known"""
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
    :return: between −1 and 1; NaN if there are fewer than 3, or all are equal
    """
    if len(x) < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return float("nan")
    matrix: Any = np.corrcoef(np.stack([_ranks(x), _ranks(y)]))
    return float(matrix[0, 1])


def _ranks(values: np.ndarray) -> np.ndarray:
    """Return ranks; equal values have the mean of theirs."""
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - (counts - 1) / 2)[places]


def summarise(episodes: Sequence[Episode]) -> dict[str, float]:
    """
    Summarise episodes in three numbers.

    :return: ``overestimation`` (mean over steps and critics, in units of the critics' return) and
        ``calibration_error`` (mean over levels and critics of |observed − nominal|, between 0 and 0.5 or so), every
        episode with the same weight; ``std_error_correlation``, of σ and |G − μ| by ranks over the steps of all
        episodes, mean over critics; without episodes of known returns, nothing
    """
    known = [episode for episode in episodes if np.isfinite(episode.returns).any()]
    if not known:
        return {}
    frequencies = np.mean([episode.frequencies for episode in known], axis=0)
    levels = quantile_midpoints(frequencies.shape[1]).numpy()
    summary = {
        "overestimation": float(np.mean([np.nanmean(episode.overestimation) for episode in known])),
        "calibration_error": float(np.abs(frequencies - levels).mean()),
    }
    correlation = np.mean([rank_correlation(*pairs) for pairs in spread_and_error(known)])
    return summary | ({"std_error_correlation": float(correlation)} if np.isfinite(correlation) else {})


def spread_and_error(episodes: Sequence[Episode]) -> np.ndarray:
    """
    Return σ and |G − μ| at the steps whose return is known.

    :param episodes: at least one
    :return: (C, 2, steps)
    """
    std = np.concatenate([episode.stds[np.isfinite(episode.returns)] for episode in episodes])
    error = np.concatenate([np.abs(episode.overestimation[np.isfinite(episode.returns)]) for episode in episodes])
    return np.stack([std.T, error.T], axis=1)


class Recording:
    """
    Collects the steps of an episode, and at its end asks the critics about them all at once.

    :param model: its critics, γ and λ
    :param every: distance of the steps to look at, at least 1; the rewards of all steps count
    :param normalization: what turns the rewards into those that the critics were trained on, if they are not yet
    """

    def __init__(self, model: TDC, every: int = 1, normalization: VecNormalize | None = None):
        self.model, self.every, self.normalization = model, every, normalization
        self.start()

    def start(self) -> None:
        """Begin an episode."""
        self.rewards: list[float] = []
        self.observations: list[Any] = []
        self.actions: list[np.ndarray] = []

    def add(self, observation: Any, action: np.ndarray, reward: float) -> None:
        """
        Record one step.

        :param observation: without a batch axis, as the policy saw it
        :param action: (A,)
        :param reward: as the environment gave it
        """
        if len(self.rewards) % self.every == 0:
            self.observations.append(observation)
            self.actions.append(action)
        self.rewards.append(reward)

    def finish(self, terminated: bool, n_shown: int | None = None) -> Episode:
        """
        End the episode, and ask the critics about its steps.

        :param terminated: whether the episode ended by itself
        :param n_shown: leave out the steps from this one on
        """
        n_steps = len(self.rewards)
        rewards = np.asarray(self.rewards)
        if self.normalization is not None:
            rewards = self.normalization.normalize_reward(rewards)  # as they are, if it does not normalise rewards
        returns = discounted_returns(rewards, self.model.gamma)
        returns[known_steps(n_steps, terminated, self.model.gamma) :] = np.nan
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
    :param actions: (T, A), as given to the environment
    :return: (T, C, N) quantiles of the critics, on the CPU
    """
    policy = model.policy
    policy.set_training_mode(False)
    predicted = []
    for begin in range(0, len(observations), batch_size):
        some = observations[begin : begin + batch_size]
        stacked = {k: np.stack([o[k] for o in some]) for k in some[0]} if isinstance(some[0], dict) else np.stack(some)
        with th.no_grad():
            scaled = th.as_tensor(policy.scale_action(actions[begin : begin + batch_size]), device=model.device)
            predicted.append(policy.critic(policy.obs_to_tensor(stacked)[0], scaled.float().flatten(1)).cpu())
    return th.cat(predicted)


def record_episodes(model: TDC, env: VecEnv, n_episodes: int, limit: int | None = None) -> list[Episode]:
    """
    Play the mean action in one environment.

    :param env: whose rewards are those that the critics were trained on
    :param limit: leave out the steps from this one on; their rewards still count
    """
    recording = Recording(model)
    episodes: list[Episode] = []
    observation: Any = env.reset()
    while len(episodes) < n_episodes:
        action, _ = model.predict(observation, deterministic=True)
        single = {k: v[0] for k, v in observation.items()} if isinstance(observation, dict) else observation[0]
        observation, rewards, dones, infos = env.step(action)
        recording.add(single, action[0], float(rewards[0]))
        if dones[0]:
            episodes.append(recording.finish(not infos[0].get("TimeLimit.truncated", False), limit))
            recording.start()
    return episodes
