"""Discounted returns of finished episodes, and of which of their steps they are known."""

import numpy as np

# A return is known where at most this share of a discounted stream of rewards comes after the end of what was played
TOLERANCE = 0.01


def discounted_returns(rewards: np.ndarray, gamma: float) -> np.ndarray:
    """
    The discounted sum of the rewards from every step on, G_t = r_t + γ·G_{t+1}.

    :param rewards: (T,)
    :return: (T,); what would have come after the last reward is not in it
    """
    returns = np.empty(len(rewards))
    following = 0.0
    for step in reversed(range(len(rewards))):
        returns[step] = following = rewards[step] + gamma * following
    return returns


def known_steps(n_steps: int, terminated: bool, gamma: float, tolerance: float = TOLERANCE) -> int:
    """
    From how many first steps of an episode the whole discounted return has been seen.

    :param terminated: whether it ended by itself; after a time limit, rewards would have gone on
    :param tolerance: the largest weight γ^(T−t) of what was not seen
    :return: between 0 and ``n_steps``
    """
    if terminated:
        return n_steps
    return max(n_steps - steps_until_negligible(gamma, tolerance), 0) if gamma < 1 else 0


def steps_until_negligible(gamma: float, tolerance: float = TOLERANCE) -> int:
    """Return the smallest n with γ^n at most ``tolerance``, for γ < 1."""
    return int(np.ceil(np.log(tolerance) / np.log(gamma))) if gamma > 0 else 1
