"""
Returns of runs → the numbers of tables and figures: functions of arrays that read no file.

The axes are, in this order: runs (seeds), then bins or tasks, then episodes. A run is one seed, and the unit of every
interval: episodes of one run say nothing about the next seed. NaN stands for "cannot be known".
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import integrate, stats


def bin_edges(last_step: int, width: int) -> np.ndarray:
    """Return the multiples of ``width`` from 0 to the first that is at least ``last_step``, (bins + 1,)."""
    if last_step < 1 or width < 1:
        raise ValueError(f"last_step and width must be at least 1, got {last_step} and {width}")
    return np.arange(0, -(-last_step // width) + 1) * width


def bin_means(steps: np.ndarray, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """
    Return the mean of the values in every bin (edges[b], edges[b+1]]: step 20,000 belongs to the bin that it ends.

    :param steps: (n,)
    :param values: (n,)
    :param edges: (bins + 1,), increasing
    :return: (bins,), NaN where a bin is empty
    """
    inside = np.isfinite(values)
    index = np.searchsorted(edges, steps[inside], side="left") - 1
    kept = (index >= 0) & (index < len(edges) - 1)
    index, values = index[kept], values[inside][kept]
    counts = np.bincount(index, minlength=len(edges) - 1)
    sums = np.bincount(index, weights=values, minlength=len(edges) - 1)
    return np.divide(sums, counts, out=np.full(len(counts), np.nan), where=counts > 0)


def mean_interval(values: np.ndarray, confidence: float = 0.95) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Return the mean over runs and its confidence interval by Student's t, which accounts for the few seeds of RL.

    :param values: (runs, ...); NaN is left out
    :return: mean, low, high, each (...); the interval is NaN where there are fewer than two runs
    """
    n = np.isfinite(values).sum(axis=0)
    mean = np.divide(np.nansum(values, axis=0), n, out=np.full(n.shape, np.nan), where=n > 0)
    squares = np.nansum((values - mean) ** 2, axis=0)
    variance = np.divide(squares, n - 1, out=np.full(n.shape, np.nan), where=n > 1)
    return interval_of(mean, np.sqrt(variance), n, confidence)


def interval_of(
    mean: np.ndarray, std: np.ndarray, n: np.ndarray | int, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Return the mean and its confidence interval, as :func:`mean_interval` does, from summary statistics.

    :param mean: mean over the runs
    :param std: sample standard deviation over the runs; NaN for fewer than two
    :param n: number of runs
    :return: mean, low, high
    """
    half = stats.t.ppf((1 + confidence) / 2, np.maximum(n - 1, 1)) * std / np.sqrt(np.maximum(n, 1))
    return mean, mean - half, mean + half


def final_return(returns: np.ndarray) -> float:
    """
    Return the mean of the last evaluation of one run.

    :param returns: (evaluations, episodes) of one run
    """
    return float(returns[-1].mean())


def best_return(returns: np.ndarray) -> float:
    """
    Return the mean of the best evaluation of one run.

    As a maximum over noisy means, it is biased upwards: the more, the fewer episodes an evaluation has.

    :param returns: (evaluations, episodes)
    """
    return float(returns.mean(axis=1).max())


def area_under_curve(steps: np.ndarray, returns: np.ndarray) -> float:
    """
    Return the mean height of one run's learning curve, by the trapezoidal rule between its first and last evaluation.

    :param steps: (evaluations,), increasing
    :param returns: (evaluations, episodes)
    :return: in units of return; for a single evaluation, its mean
    """
    means = returns.mean(axis=1)
    return float(integrate.trapezoid(means, steps) / (steps[-1] - steps[0])) if len(steps) > 1 else float(means[0])


def mean(values: np.ndarray) -> float:
    """
    Return the mean across seeds; NaN where there are none.

    :param values: (runs,)
    """
    return float(values.mean()) if len(values) else float("nan")


def spread(values: np.ndarray) -> float:
    """
    Return the sample standard deviation across seeds; NaN for fewer than two.

    :param values: (runs,)
    """
    return float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")


def spread_interval(values: np.ndarray, confidence: float = 0.95) -> tuple[float, float]:
    """
    Return the confidence interval of the standard deviation by χ², which assumes normal values.

    :param values: (runs,)
    :return: low, high; NaN for fewer than two
    """
    n = len(values)
    if n < 2:
        return float("nan"), float("nan")
    tails = stats.chi2.ppf([(1 + confidence) / 2, (1 - confidence) / 2], n - 1)
    low, high = np.sqrt((n - 1) / tails) * spread(values)
    return float(low), float(high)


def holm(p_values: np.ndarray) -> np.ndarray:
    """
    Correct p-values for their number, by Holm's method.

    :param p_values: (n,); NaN is left as it is, and not counted
    :return: (n,), at most 1
    """
    known = np.flatnonzero(np.isfinite(p_values))
    order = known[np.argsort(p_values[known])]
    corrected = np.full(len(p_values), np.nan)
    corrected[order] = np.minimum(np.maximum.accumulate(p_values[order] * np.arange(len(order), 0, -1)), 1)
    return corrected


def interquartile_mean(*tasks: np.ndarray, axis: int = -1) -> np.ndarray:
    """
    Return the mean of the middle half of the scores of all runs on all tasks; for fewer than four scores, of all.

    :param tasks: for every task, the scores, (..., runs) with the runs along ``axis``
    """
    return stats.trim_mean(np.concatenate(tasks, axis=axis), 0.25, axis=axis)


def iqm_interval(
    tasks: Sequence[np.ndarray], seed: int = 0, confidence: float = 0.95, resamples: int = 5_000
) -> tuple[float, float]:
    """
    Return the stratified bootstrap interval of the interquartile mean.

    Seeds are resampled within every task (percentile method). Resampling knows only the seeds at hand: with a handful
    of them, the interval tends to be too narrow.

    :param tasks: for every task, the scores, (runs,)
    :param seed: seed of the resampling
    :return: low, high; NaN if a task has fewer than two runs
    """
    if min(map(len, tasks)) < 2:
        return float("nan"), float("nan")
    result = stats.bootstrap(
        tuple(tasks),
        interquartile_mean,
        n_resamples=resamples,
        confidence_level=confidence,
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


def normalise_scores(returns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """
    Return scores that can be averaged over tasks: 0 and 1 are the lowest and the highest single run on the task.

    :param returns: for every algorithm, its returns on one task, (runs,)
    :return: for every algorithm, its scores between 0 and 1, (runs,); all 0.5 if all runs are equal
    """
    pooled = np.concatenate(list(returns.values()))
    low, width = pooled.min(), np.ptp(pooled)
    return {name: (r - low) / width if width > 0 else np.full(len(r), 0.5) for name, r in returns.items()}
