"""Discounted returns of finished episodes, and the steps at which they are known."""

import math

import numpy as np

# A return is known if at most this share of a constant, discounted stream of rewards lies after the last step played
TOLERANCE = 0.01


def discounted_returns(rewards: np.ndarray, gamma: float, following: float = 0.0) -> np.ndarray:
    """
    Return the discounted sum of the rewards from every step on, G_t = r_t + γ·G_{t+1}.

    :param rewards: (T,)
    :param following: G_T, the return after the last reward
    :return: (T,)
    """
    returns = np.empty(len(rewards))
    for step in reversed(range(len(rewards))):
        returns[step] = following = rewards[step] + gamma * following
    return returns


def known_steps(
    n_steps: int, terminated: bool, gamma: float, limit: int | None = None, tolerance: float = TOLERANCE
) -> int:
    """
    Return how many initial steps have a known discounted return, however the episode ended.

    :param terminated: whether the episode ended by itself; after a time limit, there would have been more rewards
    :param limit: the time limit of the task. Steps closer to it than the discount horizon are excluded; otherwise only
        early failures would count there
    :param tolerance: the largest weight γ^(T−t) of the rewards that were not seen
    :return: between 0 and ``n_steps``
    """
    unseen = steps_until_negligible(gamma, tolerance) if gamma < 1 else math.inf
    known = n_steps if terminated else n_steps - unseen + 1  # of the last of these, γ^unseen is not seen
    if limit is not None:
        known = min(known, limit - unseen + 1)
    return int(max(known, 0))


def steps_until_negligible(gamma: float, tolerance: float = TOLERANCE) -> int:
    """Return the smallest n with γ^n at most ``tolerance``, for γ < 1."""
    return int(np.ceil(np.log(tolerance) / np.log(gamma))) if gamma > 0 else 1
