"""
The paper's claims, each examined on the available runs: what is compared, with which numbers, and the verdict.

A verdict on a difference needs 95 % intervals over seeds that do not overlap; one on equality, intervals that lie
within a tenth of the returns, or farther apart. Anything else is undecided. One seed decides nothing.
A claim is examined only on the tasks for which the paper makes it.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sb3_tdc.experiments import statistics
from sb3_tdc.experiments.groups import EVALUATION, Group, as_shipped, by_conditions, is_as_shipped, vary
from sb3_tdc.experiments.results import Run
from sb3_tdc.experiments.suites import MUJOCO, PYBULLET

# By task: the algorithms that the paper compares with
_BASELINES = {**dict.fromkeys(MUJOCO, ("td3", "sac", "meow", "ddpg")), **dict.fromkeys(PYBULLET, ("sac",))}
# The χ² interval assumes normal values. Where some seeds leave a plateau and others do not, two groups drawn from the
# same distribution would be told apart in a fifth of all cases with three seeds each, and in a hundredth with ten
MIN_SEEDS_OF_SPREAD = 10
# Two returns are the same, or comparable, if they differ by at most this share of the larger mean
_SAME = 0.1
# The paper's "larger λ" of Fig. 3
_LARGE_LAM = 0.75


@dataclass(frozen=True)
class Interval:
    """
    A number with its 95 % interval over seeds, which is NaN for fewer than two seeds.

    :param n: the number of seeds
    """

    value: float
    low: float
    high: float
    n: int

    def is_above(self, other: "Interval") -> bool:
        return self.low > other.high

    @property
    def is_known(self) -> bool:
        return bool(np.isfinite([self.low, self.high]).all())


@dataclass(frozen=True)
class Claim:
    """
    One comparison that a claim of the paper requires.

    :param says: the claim
    :param group: the group on our side; both sides have the same conditions
    :param what: the compared quantity
    :param sides: names of our group and of the other
    :param ours: the quantity for our group, the one that the claim favours
    :param other: the quantity for the other group
    """

    says: str
    group: Group
    what: str
    sides: tuple[str, str]
    ours: Interval
    other: Interval
    verdict: str


def judge(ours: Interval, other: Interval) -> str:
    """Return the verdict on the claim that ours is larger."""
    if not (ours.is_known and other.is_known):
        return "undecided: too few seeds"
    if ours.is_above(other):
        return "held"
    return "not held" if other.is_above(ours) else "undecided"


def judge_smaller(ours: Interval, other: Interval) -> str:
    """Return the verdict on the claim that ours is smaller."""
    return judge(other, ours)


def judge_spread(ours: Interval, other: Interval) -> str:
    """Return the verdict on the claim that ours is the smaller spread; it needs ``MIN_SEEDS_OF_SPREAD`` seeds."""
    if min(ours.n, other.n) < MIN_SEEDS_OF_SPREAD:
        return "undecided: too few seeds"
    return judge_smaller(ours, other)


def judge_at_least(ours: Interval, other: Interval) -> str:
    """Return the verdict on the claim that ours is larger, or smaller by at most a tenth of the larger mean."""
    if not (ours.is_known and other.is_known):
        return "undecided: too few seeds"
    margin = _margin(ours, other)
    if ours.low >= other.high - margin:
        return "held"
    return "not held" if ours.high < other.low - margin else "undecided"


def judge_same(ours: Interval, other: Interval) -> str:
    """Return the verdict on the claim that both are equal, within a tenth of the larger mean."""
    if not (ours.is_known and other.is_known):
        return "undecided: too few seeds"
    margin = _margin(ours, other)
    nearest = max(ours.low - other.high, other.low - ours.high)
    farthest = max(ours.high - other.low, other.high - ours.low)
    return "held" if farthest <= margin else "not held" if nearest > margin else "undecided"


def _margin(ours: Interval, other: Interval) -> float:
    return _SAME * max(abs(ours.value), abs(other.value))


# ---------------------------------------------------------------- quantities


def late_return(group: Group) -> Interval:
    """Return the mean over seeds of the evaluations in the last third of a run, with Student's t interval."""
    return _mean(group.late_returns)


def spread_of_seeds(group: Group) -> Interval:
    """Return the standard deviation of late returns over seeds, with the χ² interval for normal values."""
    values = group.late_returns
    low, high = statistics.spread_interval(values)
    return Interval(statistics.spread(values), low, high, len(values))


def late_spread(group: Group) -> Interval:
    """Return the scatter of a run's evaluations late in training, as the mean over seeds."""
    return _mean([_scatter_of_late_evaluations(run) for run in group.finished])


def late_td_error_variance(group: Group) -> Interval:
    """Return log10 of the variance of TD errors late in training, as the mean over seeds."""
    return _mean([_log_of_late_td_errors(run) for run in group.finished])


def _scatter_of_late_evaluations(run: Run) -> float:
    """Return the standard deviation about a straight line, so that steady improvement does not count as scatter."""
    late = run.late_evaluations()
    if len(late) < 3:
        return float("nan")
    steps = np.arange(len(late))
    residuals = late - np.polynomial.Polynomial.fit(steps, late, 1)(steps)
    return float(np.sqrt((residuals**2).sum() / (len(late) - 2)))


def _log_of_late_td_errors(run: Run) -> float:
    late = run.late("train/td_error_var")
    late = late[late > 0]
    return float(np.log10(late).mean()) if len(late) else float("nan")


def _mean(values: Iterable[float]) -> Interval:
    known = np.array([value for value in values if np.isfinite(value)])
    if not len(known):
        return Interval(np.nan, np.nan, np.nan, 0)
    mean, low, high = map(float, statistics.mean_interval(known))
    return Interval(mean, low, high, len(known))


# ---------------------------------------------------------------- claims

Quantity = tuple[str, Callable[[Group], Interval]]
Verdict = Callable[[Interval, Interval], str]
_RETURN: Quantity = ("mean return in the last third", late_return)
_SEEDS: Quantity = ("standard deviation of that mean over seeds", spread_of_seeds)
_LATE_SPREAD: Quantity = ("scatter of a run's evaluations in its last third, about their trend", late_spread)
_TD_ERRORS: Quantity = ("log10 of the variance of TD errors in the last third", late_td_error_variance)

_INTERCHANGEABLE = "4. The heads are interchangeable"
# The claim and the verdict for each task; "ours" is the stochastic head
_HEADS: dict[str, tuple[str, Verdict]] = {
    "HalfCheetah-v4": (_INTERCHANGEABLE, judge_same),
    "Humanoid-v4": (_INTERCHANGEABLE, judge_same),
    "Hopper-v4": (_INTERCHANGEABLE, judge_same),
    "Ant-v4": ("4. Ant favours the deterministic head", judge_smaller),
    "Walker2d-v4": ("4. Walker2d favours the stochastic head", judge),
}


def examine(groups: Sequence[Group]) -> list[Claim]:
    """Return the comparisons that the groups allow for each claim, in the order of the claims, under all conditions."""
    claims = (_returns, _variances, _lambdas, _heads, _td_errors)
    under_conditions = by_conditions((g for g in groups if g.finished), (*MUJOCO, *PYBULLET)).values()
    return [compared for claim in claims for alike in under_conditions for compared in claim(alike)]


def _returns(groups: Sequence[Group]) -> Iterator[Claim]:
    for plain, baseline in _baselines(groups):
        yield _claim("1. λ-LCB has the highest return, or a comparable one", _RETURN, plain, baseline, judge_at_least)


def _variances(groups: Sequence[Group]) -> Iterator[Claim]:
    for plain, baseline in _baselines(group for group in groups if group.env_id in MUJOCO):
        yield _claim("2. λ-LCB varies less", _SEEDS, plain, baseline, judge_spread)
        # The scatter depends on the interval between evaluations and on the episodes in each
        if all(plain.setting(key) == baseline.setting(key) for key in EVALUATION):
            yield _claim("2. λ-LCB varies less", _LATE_SPREAD, plain, baseline, judge_smaller)


def _lambdas(groups: Sequence[Group]) -> Iterator[Claim]:
    for some in _ablations(groups, "lam", "Humanoid-v4", "HalfCheetah-v4"):
        numbers = [group for group in some if not isinstance(group.setting("lam"), str)]
        if len(numbers) > 1 and numbers[0].setting("lam") < _LARGE_LAM <= numbers[-1].setting("lam"):
            yield _claim("3. A larger λ tightens the bands", _SEEDS, numbers[-1], numbers[0], judge_spread)
            if some[0].env_id == "Humanoid-v4":
                yield _claim("3. On Humanoid, a larger λ returns more", _RETURN, numbers[-1], numbers[0], judge)


def _heads(groups: Sequence[Group]) -> Iterator[Claim]:
    for deterministic, stochastic in _ablations(groups, "stochastic_actor", *_HEADS):
        says, verdict = _HEADS[deterministic.env_id]
        yield _claim(says, _RETURN, stochastic, deterministic, verdict)


def _td_errors(groups: Sequence[Group]) -> Iterator[Claim]:
    for some in _ablations(groups, "lam", "Hopper-v4"):
        of_lam = {group.setting("lam"): group for group in some}
        if {0, 1} <= set(of_lam):
            yield _claim("5. λ = 1 lowers the variance of TD errors", _TD_ERRORS, of_lam[1], of_lam[0], judge_smaller)


def _baselines(groups: Iterable[Group]) -> Iterator[tuple[Group, Group]]:
    """Yield pairs of TDC and a baseline of the paper on the task, both with the hyperparameters of ``hyperparams/``."""
    shipped = as_shipped(list(groups))
    for plain in (group for group in shipped if group.algo == "tdc"):
        for baseline in (group for group in shipped if group.algo in _BASELINES.get(plain.env_id, ())):
            yield plain, baseline


def _ablations(groups: Sequence[Group], key: str, *env_ids: str) -> list[list[Group]]:
    """Return lists of TDC groups that differ from ``hyperparams/`` in one setting at most, ordered by that setting."""
    return vary(
        (g for g in groups if g.algo == "tdc" and g.env_id in env_ids and is_as_shipped(g.runs[0], but={key})), key
    )


def _claim(says: str, quantity: Quantity, ours: Group, other: Group, verdict: Verdict) -> Claim:
    what, measure = quantity
    intervals = measure(ours), measure(other)
    is_measured = all(interval.n for interval in intervals)
    found = verdict(*intervals) if is_measured else "undecided: too few values in the last third"
    return Claim(says, ours, what, (ours.name, other.name), *intervals, found)
