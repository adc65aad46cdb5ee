"""
The paper's claims, each against the runs that are there: what is compared, on which numbers, and the verdict.

A verdict needs 95 % intervals over seeds that do not overlap; anything else is undecided. One seed decides nothing.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sb3_tdc.experiments import statistics
from sb3_tdc.experiments.results import Group, Run, differences, vary

RIVALS = ("td3", "sac", "meow")
# The χ² interval is of normal values. Where some seeds leave a plateau and others do not, three seeds of one and the
# same law would be told apart in a fifth of all cases, and ten in a hundredth
MIN_SEEDS_OF_SPREAD = 10
# Heads are interchangeable if they differ by at most this share of the larger mean
_SAME = 0.1


@dataclass(frozen=True)
class Interval:
    """
    A number with its 95 % interval over seeds; NaN if there are fewer than two.

    :param n: seeds
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
    One comparison.

    :param says: what the paper claims
    :param what: the quantity that is compared
    :param ours: of the side that the claim favours; :param other: of the other side
    """

    says: str
    env_id: str
    n_timesteps: int
    what: str
    sides: tuple[str, str]
    ours: Interval
    other: Interval
    verdict: str


def judge(ours: Interval, other: Interval) -> str:
    """Return the verdict on the claim that ours is the larger one."""
    if not (ours.is_known and other.is_known):
        return "undecided: too few seeds"
    if ours.is_above(other):
        return "held"
    return "not held" if other.is_above(ours) else "undecided"


def judge_smaller(ours: Interval, other: Interval) -> str:
    """Return the verdict on the claim that ours is the smaller one."""
    return judge(other, ours)


def judge_spread(ours: Interval, other: Interval) -> str:
    """Return the verdict on the claim that ours is the smaller spread."""
    if min(ours.n, other.n) < MIN_SEEDS_OF_SPREAD:
        return "undecided: too few seeds"
    return judge_smaller(ours, other)


def judge_same(ours: Interval, other: Interval) -> str:
    """Return the verdict on the claim that both are the same, within a tenth of the larger mean."""
    if not (ours.is_known and other.is_known):
        return "undecided: too few seeds"
    margin = _SAME * max(abs(ours.value), abs(other.value))
    nearest = max(ours.low - other.high, other.low - ours.high)
    farthest = max(ours.high - other.low, other.high - ours.low)
    return "held" if farthest <= margin else "not held" if nearest > margin else "undecided"


# ---------------------------------------------------------------- quantities


def final_return(runs: Sequence[Run]) -> Interval:
    """Return the mean over seeds of the last evaluation, with Student's interval."""
    return _mean([statistics.final_return(run.evaluations.returns) for run in runs if run.evaluations])


def spread_of_seeds(runs: Sequence[Run]) -> Interval:
    """Return the standard deviation of final returns over seeds, with the χ² interval of normal values."""
    values = np.array([statistics.final_return(run.evaluations.returns) for run in runs if run.evaluations])
    low, high = statistics.spread_interval(values)
    return Interval(statistics.spread(values), low, high, len(values))


def late_spread(runs: Sequence[Run]) -> Interval:
    """Return how much the evaluations of one run differ late in training: their standard deviation, mean over seeds."""
    return _mean([_std_of_late_evaluations(run) for run in runs])


def late_td_error_variance(runs: Sequence[Run]) -> Interval:
    """Return log10 of the variance of TD errors late in training, mean over seeds."""
    return _mean([_log_of_late_td_errors(run) for run in runs])


def _std_of_late_evaluations(run: Run) -> float:
    late = run.late_evaluations()
    return float(np.std(late, ddof=1)) if len(late) > 1 else float("nan")


def _log_of_late_td_errors(run: Run) -> float:
    late = run.late("train/td_error_var")
    late = late[late > 0]
    return float(np.log10(late).mean()) if len(late) else float("nan")


def _mean(values: Sequence[float]) -> Interval:
    known = np.array([value for value in values if np.isfinite(value)])
    if not len(known):
        return Interval(np.nan, np.nan, np.nan, 0)
    mean, low, high = map(float, statistics.mean_interval(known))
    return Interval(mean, low, high, len(known))


# ---------------------------------------------------------------- claims

Quantity = tuple[str, Callable[[Sequence[Run]], Interval]]
_RETURN: Quantity = ("final return", final_return)
_SEEDS: Quantity = ("standard deviation of final returns over seeds", spread_of_seeds)
_LATE_SPREAD: Quantity = ("standard deviation of a run's evaluations in its last third", late_spread)
_TD_ERRORS: Quantity = ("log10 of the variance of TD errors in the last third", late_td_error_variance)


def examine(groups: Sequence[Group]) -> list[Claim]:
    """Compare what there is for each claim, on every task and number of steps, in the order of the claims."""
    claims = (_returns, _variances, _lambdas, _heads, _td_errors)
    return [compared for claim in claims for compared in claim(groups)]


def _returns(groups: Sequence[Group]) -> Iterator[Claim]:
    for plain, rival in _rivals(groups):
        yield _claim("1. λ-LCB has higher final returns", _RETURN, plain, rival, judge)


def _variances(groups: Sequence[Group]) -> Iterator[Claim]:
    for plain, rival in _rivals(groups):
        for quantity in (_SEEDS, _LATE_SPREAD):
            yield _claim("2. λ-LCB varies less", quantity, plain, rival, judge_spread)


def _lambdas(groups: Sequence[Group]) -> Iterator[Claim]:
    for larger, smaller in _pairs_of(groups, "lam"):
        yield _claim("3. A larger λ tightens the bands", _SEEDS, larger, smaller, judge_spread)


def _heads(groups: Sequence[Group]) -> Iterator[Claim]:
    for stochastic, deterministic in _pairs_of(groups, "stochastic_actor"):
        yield _claim("4. The heads are interchangeable", _RETURN, stochastic, deterministic, judge_same)


def _td_errors(groups: Sequence[Group]) -> Iterator[Claim]:
    for larger, smaller in _pairs_of(groups, "lam"):
        if larger.env_id.startswith("Hopper-v") and smaller.setting("lam") == 0:
            yield _claim("5. λ lowers the variance of TD errors on Hopper", _TD_ERRORS, larger, smaller, judge_smaller)


def _rivals(groups: Sequence[Group]) -> Iterator[tuple[Group, Group]]:
    """Pairs of TDC and a rival, both as ``hyperparams/`` has them."""
    as_shipped = [group for group in groups if group.finished and _is_as_shipped(group)]
    for plain in as_shipped:
        for rival in as_shipped if plain.algo == "tdc" else ():
            if rival.algo in RIVALS and _is_alike(plain, rival):
                yield plain, rival


def _is_as_shipped(group: Group) -> bool:
    """Return whether a group has the hyperparameters of ``hyperparams/``, but for its length and its warm-up."""
    differing = differences(group.runs[0])
    warm_up = differing.pop("learning_starts", None)
    return not set(differing) - {"n_timesteps", "eval_freq", "mujoco"} and warm_up in (None, group.n_timesteps // 10)


def _pairs_of(groups: Sequence[Group], key: str) -> Iterator[tuple[Group, Group]]:
    """Pairs of TDC that differ in one number or switch alone: the largest and the smallest."""
    of_tdc = [group for group in groups if group.algo == "tdc" and group.finished]
    for some in vary(of_tdc, key):
        numbers = sorted((g for g in some if not isinstance(g.setting(key), str)), key=lambda g: float(g.setting(key)))
        if len(numbers) > 1:
            yield numbers[-1], numbers[0]


def _is_alike(one: Group, other: Group) -> bool:
    """Return whether two groups may be compared: the same task, length and physics."""
    return (
        all(one.setting(key) == other.setting(key) for key in ("n_timesteps", "mujoco")) and one.env_id == other.env_id
    )


def _claim(
    says: str, quantity: Quantity, ours: Group, other: Group, verdict: Callable[[Interval, Interval], str]
) -> Claim:
    what, measure = quantity
    intervals = measure(ours.finished), measure(other.finished)
    sides = ours.label, other.label
    return Claim(says, ours.env_id, ours.n_timesteps, what, sides, *intervals, verdict(*intervals))
