"""Scores over tasks: which algorithms have runs of one length on the same tasks, and how they compare there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sb3_tdc.experiments import statistics
from sb3_tdc.experiments.groups import Group

FULL = "all steps of hyperparams/"


@dataclass(frozen=True)
class Aggregate:
    """
    Algorithms as ``hyperparams/`` has them, on tasks on which each has at least two finished seeds.

    :param length: of their runs; :data:`FULL` where tasks have different numbers of steps
    :param scores: for every algorithm and task (runs,): 0 and 1 are the lowest and the highest single run on the task
    :param left_out: algorithms with two seeds on some of the tasks, or on others
    """

    length: str
    env_ids: tuple[str, ...]
    scores: dict[str, list[np.ndarray]]
    left_out: tuple[str, ...]

    def intervals(self) -> list[tuple[float, float, float]]:
        """Return the interquartile mean of every algorithm, and its 95 % stratified bootstrap interval."""
        return [
            (float(statistics.interquartile_mean(*tasks)), *statistics.iqm_interval(tasks))
            for tasks in self.scores.values()
        ]


def length_of(group: Group) -> str:
    """Return :data:`FULL`, or the number of steps of a run of another length than ``hyperparams/`` has."""
    return FULL if group.n_timesteps == group.shipped_steps else f"{group.n_timesteps:,} steps"


def aggregate(groups: Sequence[Group]) -> list[Aggregate]:
    """Return what can be averaged over tasks: at least two algorithms on at least two tasks, at one length."""
    lengths: dict[tuple[str, str], dict[str, dict[str, Group]]] = {}
    for group in groups:
        if len(group.finished) > 1 and group.is_as_shipped:
            algorithms = lengths.setdefault((length_of(group), group.conditions.mujoco), {})
            algorithms.setdefault(group.algo.upper(), {})[group.env_id] = group
    found = (_score(length, algorithms) for (length, _), algorithms in lengths.items())
    return [one for one in found if one is not None]


def _score(length: str, algorithms: dict[str, dict[str, Group]]) -> Aggregate | None:
    labels, env_ids = choose({label: list(of_label) for label, of_label in algorithms.items()})
    if len(labels) < 2:
        return None
    scores: dict[str, list[np.ndarray]] = {label: [] for label in labels}
    for env_id in env_ids:
        final = {label: algorithms[label][env_id].final_returns for label in labels}
        for label, values in statistics.normalise_scores(final).items():
            scores[label].append(values)
    return Aggregate(length, env_ids, scores, tuple(label for label in algorithms if label not in labels))


def choose(tasks: dict[str, list[str]]) -> tuple[list[str], tuple[str, ...]]:
    """
    Choose algorithms that share at least two tasks: the one with the fewest tasks leaves until they do.

    :param tasks: of every algorithm
    :return: the algorithms, in the order given, and the tasks of all of them; empty if no two algorithms share two
    """
    chosen = list(tasks)
    while len(chosen) > 1:
        common = [task for task in tasks[chosen[0]] if all(task in tasks[other] for other in chosen)]
        if len(common) > 1:
            return chosen, tuple(common)
        chosen.remove(min(reversed(chosen), key=lambda label: len(tasks[label])))
    return [], ()
