"""
What λ does: where it changes the choice of the target critic, and what that adds to the target.

Let critic m have the smallest mean. λ > 0 prefers critic i where σ_i > σ_m and λ > (μ_i − μ_m)/(σ_i − σ_m). So the
mean of the target is a non-decreasing step function of λ, from the smallest mean at λ = 0 upwards.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th

from sb3_tdc.common.checks import check_number
from sb3_tdc.common.returns import discounted_returns, known_steps
from sb3_tdc.tdc.quantiles import Target

QUANTILES = (0.1, 0.5, 0.9)
# The largest λ of a calibration: beyond, the wider critic is selected nearly everywhere
MAX_LAM = 10.0
# η, the change of λ for an error of one unit of its scale, per 1,000 steps
RATE = 0.1
# The weight of an episode's error in the scale, per 1,000 steps
SCALE_WEIGHT = 0.05
# Steps of an episode between those whose values are predicted: neighbours tell the same
EVERY = 10


def critical_lam(mean: th.Tensor, std: th.Tensor) -> th.Tensor:
    """
    Return λ*, above which another critic is selected than at λ = 0.

    :param mean: (B, C)
    :param std: (B, C)
    :return: (B,), at least 0; infinite where the critic with the smallest mean also has the largest σ
    """
    first = mean.argmin(dim=1, keepdim=True)
    more_mean, more_std = mean - mean.gather(1, first), std - std.gather(1, first)
    thresholds = th.where(more_std > 0, more_mean / more_std.clamp(min=th.finfo(std.dtype).tiny), th.inf)
    return thresholds.amin(dim=1)


def describe_selection(target: Target) -> dict[str, th.Tensor]:
    """
    Measure what λ did to a minibatch; docs/tdc.md has the equations.

    :param target: of the minibatch
    :return: scalars by name; those of λ* only where it is finite for a transition
    """
    _, mean, std, selected = target
    column = selected.unsqueeze(1)
    added = (mean.gather(1, column) - mean.amin(dim=1, keepdim=True)).mean()
    critical = critical_lam(mean, std)
    found = {
        "lam_changes": (mean.argmin(dim=1) != selected).float().mean(),
        "lam_adds": added,
        "lam_adds_in_std": added / std.gather(1, column).mean().clamp(min=1e-12),
        "lam_can_change": critical.isfinite().float().mean(),
    }
    finite = critical[critical.isfinite()]
    if len(finite):
        at = th.tensor(QUANTILES, dtype=finite.dtype, device=finite.device)
        quantiles = finite.quantile(at)
        found |= {f"lam_critical_q{round(100 * q)}": quantiles[i] for i, q in enumerate(QUANTILES)}
    return found


# ---------------------------------------------------------------- λ by calibration (ACC, Dorka et al. 2021)


def initial_lam(lam: str) -> float:
    """
    Return where a calibrated λ begins.

    :param lam: "auto" (from 1), or "auto_" and a number
    :raises ValueError: for any other text
    """
    start = lam.removeprefix("auto").removeprefix("_") or "1.0"
    try:
        if lam.startswith("auto"):
            return check_number("lam", float(start), 0.0, MAX_LAM)
    except ValueError:
        pass
    raise ValueError(
        f'lam must be a finite number of at least 0.0, a schedule, "auto", or "auto_" and a number up to {MAX_LAM:g} '
        f'(as in "auto_0.5"), got {lam!r}'
    )


def calibrate(lam: float, scale: float, errors: np.ndarray, n_steps: int, least: float = 0.0) -> tuple[float, float]:
    """
    Move λ towards values that are right on average: up after underestimation, down after overestimation.

    λ ← clip(λ + η·w·mean(G − Q₁)/scale, least, λ_max), where scale is a moving average of |G − Q₁| and w = n/1,000, so
    that neither the scale of rewards nor the length of episodes matters.

    :param lam: λ
    :param scale: 0 before the first episode
    :param errors: G − Q₁ at some steps of an episode
    :param n_steps: n, the steps of the episode that these stand for
    :return: λ and scale
    """
    size, weight = float(np.abs(errors).mean()), n_steps / 1_000
    share = 1 - (1 - SCALE_WEIGHT) ** weight
    scale = scale + share * (size - scale) if scale > 0 else size
    step = RATE * weight * float(errors.mean()) / scale if scale > 0 else 0.0
    return float(np.clip(lam + step, least, MAX_LAM)), scale


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
            self.observations.append(observation)
            self.actions.append(action)
        self.rewards.append(reward)

    def finish(self, rewards: Sequence[float], terminated: bool, gamma: float) -> tuple[np.ndarray, int]:
        """
        Return the returns that are known at the steps that were looked at, and of how many steps they are.

        :param rewards: those of the episode, in the critics' units
        :param terminated: whether it ended by itself; after a time limit its last steps are left out
        """
        n_known = known_steps(len(rewards), terminated, gamma)
        return discounted_returns(np.asarray(rewards), gamma)[:n_known:EVERY], n_known
