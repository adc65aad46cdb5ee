"""Runs → the curves of figures: binned evaluations and diagnostics of every seed."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from sb3_tdc.ablations import ABLATIONS
from sb3_tdc.experiments import figures, statistics
from sb3_tdc.experiments.groups import Group, as_shipped
from sb3_tdc.experiments.results import Run

_BIN = 20_000  # environment steps, at the paper's scale


def headline(groups: Sequence[Group]) -> list[Group]:
    """
    Choose the groups that a figure of algorithms shows, among groups under the same conditions.

    Each algorithm is shown with the hyperparameters of ``hyperparams/``; if no run with these is finished, all groups
    of the algorithm are shown. Ablations, which have their own figures, and groups without evaluations are left out.
    """
    evaluated = [g for g in groups if any(run.evaluations for run in g.runs) and g.algo not in ABLATIONS]
    shipped = as_shipped([group for group in evaluated if group.finished])
    algos = {group.algo for group in shipped}
    return [group for group in evaluated if group in shipped or group.algo not in algos]


def bin_width(group: Group) -> int:
    """
    Return the width of a bin in steps: 20,000, scaled with the length of the runs.

    It is a multiple of the group's evaluation interval, so that every bin has the same number of evaluations.
    """
    scale = group.n_timesteps / group.shipped_steps if group.shipped_steps else 1.0
    frequency = max(group.setting("eval_freq") or 0, 1)
    return max(round(_BIN * scale / frequency), 1) * frequency


def read_evaluations(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Return two arrays (evaluations,): timesteps, mean returns."""
    if run.evaluations is None:
        return np.empty(0), np.empty(0)
    return run.evaluations.timesteps, run.evaluations.returns.mean(axis=1)


def read_td_errors(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Return two arrays (log entries,): timesteps, variance of TD errors."""
    steps, variances = run.progress("time/total_timesteps", "train/td_error_var").T
    return steps, variances


def make_curve(
    group: Group, label: str, color: Any, width: int, read: Callable[[Run], tuple[np.ndarray, np.ndarray]]
) -> figures.Curve:
    """
    Bin the values of all runs of a group.

    :param read: a run → timesteps and values
    """
    edges = statistics.bin_edges(max(group.n_timesteps, *(run.steps for run in group.runs)), width)

    def stack(runs: Iterable[Run]) -> np.ndarray:
        rows = [statistics.bin_means(*read(run), edges) for run in runs]
        return np.array(rows).reshape(-1, len(edges) - 1)

    unfinished = [run for run in group.runs if run not in group.finished]
    return figures.Curve(label, color, edges[1:], stack(group.finished), stack(unfinished))
