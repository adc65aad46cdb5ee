"""Scores over tasks: which algorithms have runs of the same length on the same tasks, and how they compare."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sb3_tdc.experiments import statistics
from sb3_tdc.experiments.groups import Conditions, Group, as_shipped, by_conditions


@dataclass(frozen=True)
class Aggregate:
    """
    Algorithms with the hyperparameters of ``hyperparams/``, on tasks on which each has at least two finished seeds.

    :param length: of the runs: a number of steps, or a share of the steps in ``hyperparams/``
    :param physics: MuJoCo version of the tasks, "" where it does not matter
    :param env_ids: the tasks
    :param groups: for every algorithm, its group on each task
    :param left_out: the other algorithms and tasks that have runs of this length
    """

    length: str
    physics: str
    env_ids: tuple[str, ...]
    groups: dict[str, list[Group]]
    left_out: tuple[str, ...]

    @property
    def scores(self) -> dict[str, list[np.ndarray]]:
        """For every algorithm, its scores on each task, (runs,): 0 and 1 are the lowest and highest run on the task."""
        scores: dict[str, list[np.ndarray]] = {label: [] for label in self.groups}
        for task in range(len(self.env_ids)):
            final = {label: groups[task].final_returns for label, groups in self.groups.items()}
            for label, values in statistics.normalise_scores(final).items():
                scores[label].append(values)
        return scores

    @property
    def members(self) -> set[tuple[str, Conditions]]:
        return {(label, group.conditions) for label, groups in self.groups.items() for group in groups}

    def intervals(self) -> list[tuple[float, float, float]]:
        """Return the interquartile mean of every algorithm, with its 95 % stratified bootstrap interval."""
        return [
            (float(statistics.interquartile_mean(*tasks)), *statistics.iqm_interval(tasks))
            for tasks in self.scores.values()
        ]


def aggregate(groups: Sequence[Group]) -> list[Aggregate]:
    """Return the sets of at least two algorithms on at least two tasks, of one length, to be averaged over tasks."""
    found: list[Aggregate] = []
    for (length, physics), tasks in _at_one_length(groups).items():
        one = _score(length, physics, tasks)
        if one is not None and not any(one.members <= other.members for other in found):
            found = [other for other in found if not other.members < one.members] + [one]
    return found


def describe_share(share: float) -> str:
    """Describe the length of a run as a share of the steps in ``hyperparams/``."""
    return "all steps of hyperparams/" if share == 1 else f"{100 * share:.3g} % of the steps in hyperparams/"


def choose(tasks: Mapping[str, Sequence[str]]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """
    Choose at least two algorithms that share at least two tasks, with the most pairs of algorithm and task.

    :param tasks: for every algorithm, its tasks
    :return: the algorithms, and the tasks that all of them share, in the order given; empty if there are none
    """
    best: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    for n in range(len(tasks), 1, -1):
        for labels in combinations(tasks, n):
            common = tuple(task for task in tasks[labels[0]] if all(task in tasks[label] for label in labels))
            if len(common) > 1 and n * len(common) > len(best[0]) * len(best[1]):
                best = labels, common
    return best


def _at_one_length(groups: Sequence[Group]) -> dict[tuple[str, str], dict[str, dict[str, Group]]]:
    """
    Return the group of every algorithm and task, by length and physics.

    A group is listed by its number of steps, and again by its share of the steps in ``hyperparams/``, if any.
    """
    found: dict[tuple[str, str], dict[str, dict[str, Group]]] = {}
    for conditions, alike in by_conditions(group for group in groups if group.finished).items():
        for group in as_shipped(alike):
            for length in _lengths(conditions, group):
                algorithms = found.setdefault((length, conditions.mujoco), {})
                algorithms.setdefault(group.algo.upper(), {})[group.env_id] = group
    return found


def _lengths(conditions: Conditions, group: Group) -> Iterator[str]:
    yield f"{conditions.n_timesteps:,} steps"
    if group.shipped_steps:
        yield describe_share(group.share)


def _score(length: str, physics: str, algorithms: dict[str, dict[str, Group]]) -> Aggregate | None:
    several = {
        label: [env_id for env_id, group in of_label.items() if len(group.finished) > 1]
        for label, of_label in algorithms.items()
    }
    labels, env_ids = choose(several)
    if not labels:
        return None
    there = [*algorithms, *dict.fromkeys(env_id for of_label in algorithms.values() for env_id in of_label)]
    left_out = tuple(name for name in there if name not in (*labels, *env_ids))
    chosen = {label: [algorithms[label][env_id] for env_id in env_ids] for label in labels}
    return Aggregate(length, physics, env_ids, chosen, left_out)
