"""Runs → groups of runs that may be averaged; which groups may be compared, and how they are named."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from sb3_tdc.experiments.results import Run, canonical, default_settings, flatten, same_settings
from sb3_tdc.experiments.statistics import final_return
from sb3_tdc.hyperparams import hyperparams_file, read_entry
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS

# The length of a run, its evaluations and its simulator: not hyperparameters of the algorithm
_NOT_HYPERPARAMETERS = {"n_timesteps", "eval_freq", "eval_episodes", "mujoco"}


@dataclass(frozen=True, order=True)
class Conditions:
    """
    What runs must have in common to be compared with each other and drawn in one figure.

    :param mujoco: "before 3.5", "since 3.5" (Hopper, Ant and Humanoid move differently), or "of unknown version"; ""
        where it does not matter
    """

    env_id: str
    n_timesteps: int
    mujoco: str = ""

    def __str__(self) -> str:
        return f"{self.task}, {self.n_timesteps:,} steps"

    @property
    def task(self) -> str:
        """The environment, with MuJoCo's version unless it is that of published returns, before 3.5."""
        return f"{self.env_id}, MuJoCo {self.mujoco}" if self._is_other_mujoco else self.env_id

    @property
    def file_name(self) -> str:
        version = f"-mujoco-{self.mujoco.replace(' ', '-')}" if self._is_other_mujoco else ""
        return f"{self.env_id}-{self.n_timesteps}{version}"

    @property
    def _is_other_mujoco(self) -> bool:
        return self.mujoco not in ("", "before 3.5")


@dataclass(frozen=True)
class Group:
    """
    Runs that differ only in their seed.

    :param label: the algorithm, and the settings that distinguish it from groups of the same algorithm and conditions
    :param runs: at least one run, in the order of their seeds
    """

    label: str
    runs: tuple[Run, ...]

    @property
    def algo(self) -> str:
        return self.runs[0].algo

    @property
    def conditions(self) -> Conditions:
        return _conditions(self.runs[0])

    @property
    def env_id(self) -> str:
        return self.runs[0].env_id

    @property
    def n_timesteps(self) -> int:
        return self.runs[0].n_timesteps

    @property
    def finished(self) -> tuple[Run, ...]:
        """The runs that took all their steps, with finite evaluations: only these are averaged."""
        return tuple(run for run in self.runs if run.is_averaged)

    @property
    def seeds(self) -> str:
        """The number of finished seeds, and which: ``"3 (1, 2, 3)"``."""
        numbers = ", ".join(str(run.seed) for run in self.finished)
        return f"{len(self.finished)} ({numbers})" if numbers else "0"

    @property
    def final_returns(self) -> np.ndarray:
        """The mean of the last evaluation of every finished run, (runs,)."""
        return np.array([final_return(run.evaluations.returns) for run in self.finished if run.evaluations is not None])

    @property
    def late_returns(self) -> np.ndarray:
        """The mean of the evaluations in the last third of every finished run that has any there, (runs,)."""
        return np.array([late.mean() for run in self.finished if len(late := run.late_evaluations())])

    @property
    def shipped_steps(self) -> int:
        """Environment steps in the hyperparameter file (for the paper's tasks, the paper's); 0 if there is no file."""
        return _shipped(self.algo, self.env_id).get("n_timesteps", 0)

    @property
    def share(self) -> float:
        """The length of the runs as a fraction of the steps in the hyperparameter file; NaN if there is no file."""
        return round(self.n_timesteps / self.shipped_steps, 6) if self.shipped_steps else float("nan")

    @property
    def name(self) -> str:
        """The algorithm, and its hyperparameters that differ from ``hyperparams/``: for tables of many tasks."""
        differing = hyperparameters_not_shipped(self.runs[0]) if _shipped(self.algo, self.env_id) else {}
        return f"{self.algo.upper()}, {describe(differing)}" if differing else self.label

    @property
    def commits(self) -> tuple[str, ...]:
        """The commits of this package that the finished runs were trained with."""
        return tuple(dict.fromkeys(run.folder.versions.get("sb3_tdc", "") for run in self.finished))

    @property
    def is_as_shipped(self) -> bool:
        return is_as_shipped(self.runs[0])

    def setting(self, key: str) -> Any:
        return self.runs[0].setting(key)


def group_runs(runs: Iterable[Run]) -> list[Group]:
    """
    Group the runs that may be averaged: runs of one algorithm and environment that differ only in their seed.

    Several runs of one seed are repetitions, and only one of them stays: the last that can be averaged, else the last
    that is finished, else the last.
    """
    found: dict[str, dict[int, Run]] = {}
    for run in runs:
        seeds = found.setdefault(_identity(run), {})
        if run.seed not in seeds or _rank(run) >= _rank(seeds[run.seed]):
            seeds[run.seed] = run
    members = [tuple(seeds[seed] for seed in sorted(seeds)) for seeds in found.values()]
    groups = [Group(_label(group[0], [other[0] for other in members]), group) for group in members]
    place = {algo: i for i, algo in enumerate(KNOWN_ALGORITHMS)}
    return sorted(groups, key=lambda g: (g.conditions, place.get(g.algo, len(place)), g.label))


def by_conditions(groups: Iterable[Group], tasks: Sequence[str] = ()) -> dict[Conditions, list[Group]]:
    """
    Collect the groups that may be compared with each other: those under the same conditions.

    :param tasks: environments that come first, in this order; the others follow by name
    """
    found: dict[Conditions, list[Group]] = {}
    for group in groups:
        found.setdefault(group.conditions, []).append(group)
    order = {env_id: place for place, env_id in enumerate(tasks)}
    return dict(sorted(found.items(), key=lambda item: (order.get(item[0].env_id, len(order)), item[0])))


def vary(groups: Iterable[Group], key: str) -> list[list[Group]]:
    """
    Return the ablations of one hyperparameter.

    :return: lists of at least two groups that differ only in ``key``, ordered by its value
    """
    found: dict[str, list[Group]] = {}
    for group in groups:
        found.setdefault(_identity(group.runs[0], without=key), []).append(group)
    return [sorted(some, key=lambda g: _sortable(g.setting(key))) for some in found.values() if len(some) > 1]


def have_same_settings(one: Group, other: Group, but: str | None = None) -> bool:
    """
    Return whether two groups have the same settings, even if their algorithms differ.

    :param but: a setting that may differ
    """
    return _identity(one.runs[0], but, algo=other.algo) == _identity(other.runs[0], but)


def as_shipped(groups: Sequence[Group]) -> list[Group]:
    """
    Return one group for each algorithm, with the hyperparameters of ``hyperparams/``.

    :param groups: groups under the same conditions; if several of an algorithm differ in their evaluations or their
        warm-up, the one with the most finished seeds is taken
    """
    found: dict[str, Group] = {}
    for group in groups:
        if group.is_as_shipped and (group.algo not in found or len(group.finished) > len(found[group.algo].finished)):
            found[group.algo] = group
    return list(found.values())


def is_as_shipped(run: Run, but: Iterable[str] = ()) -> bool:
    """
    Return whether a run has the hyperparameters of this package's ``hyperparams/``, whatever its length.

    :param but: settings that may differ
    """
    return not set(hyperparameters_not_shipped(run)) - set(but)


def hyperparameters_not_shipped(run: Run) -> dict[str, Any]:
    """
    Return the hyperparameters of a run that differ from those of ``hyperparams/``.

    A warm-up that the matrix has shortened to a tenth of a short run is not among them.
    """
    differing = {key: value for key, value in differences(run).items() if key not in _NOT_HYPERPARAMETERS}
    warm_up = _shipped(run.algo, run.env_id).get("learning_starts")
    if warm_up is not None and run.setting("learning_starts") == min(warm_up, run.n_timesteps // 10):
        differing.pop("learning_starts", None)
    return differing


def differences(run: Run) -> dict[str, Any]:
    """Return the settings of a run that differ from those of this package's ``hyperparams/``, with the run's values."""
    entry = _shipped(run.algo, run.env_id)
    shipped = {**default_settings(run.algo), **entry}
    return {
        key: run.setting(key)
        for key in {**entry, **run.settings}
        if not same_settings(run.setting(key), shipped.get(key))
    }


def shared_differences(groups: Sequence[Group]) -> str:
    """
    Describe the hyperparameters in which all groups of an algorithm differ from ``hyperparams/``.

    The labels of groups name only the settings that distinguish them.

    :return: ``"All TDC: tau 0.01; all TD3: batch_size 64."``, "" if there are none
    """
    said = []
    for algo in dict.fromkeys(group.algo for group in groups):
        found = [differences(group.runs[0]) for group in groups if group.algo == algo]
        common = {
            key: value
            for key, value in found[0].items()
            if key not in _NOT_HYPERPARAMETERS and all(same_settings(other.get(key), value) for other in found)
        }
        if common:
            said.append(f"all {algo.upper()}: {describe(common)}")
    text = "; ".join(said)
    return f"{text[0].upper()}{text[1:]}." if text else ""


def describe(settings: Mapping[str, Any]) -> str:
    """Describe settings: ``{"lam": 0.5, "tau": 0.01}`` → "λ 0.5, tau 0.01"."""
    return ", ".join(_describe(key, value) for key, value in settings.items())


def _describe(key: str, value: Any) -> str:
    if key == "stochastic_actor":
        return "stochastic head" if value else "deterministic head"
    name = {"lam": "λ", "n_timesteps": "steps", "mujoco": "MuJoCo"}.get(key, key.removeprefix("policy_kwargs."))
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{name} {value:,}"
    if value is None:
        return f"{name} left to its default"
    return f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"


@cache  # a report needs each entry hundreds of times
def _shipped(algo: str, env_id: str) -> Mapping[str, Any]:
    try:
        return flatten(read_entry(hyperparams_file(algo), env_id)[0])
    except ValueError:  # an algorithm of another package has no file
        return {}


def _rank(run: Run) -> int:
    return run.is_finished + run.is_averaged


def _conditions(run: Run) -> Conditions:
    return Conditions(run.env_id, run.n_timesteps, run.setting("mujoco") or "")


def _label(run: Run, representatives: Sequence[Run]) -> str:
    """
    Return the algorithm's name, and the settings that distinguish the run and differ from ``hyperparams/``.

    A setting distinguishes if it varies among the representatives with the same algorithm and conditions.

    :param representatives: one run of every group
    """
    likes = [o for o in representatives if o.algo == run.algo and _conditions(o) == _conditions(run)]
    keys = {key for other in likes for key in other.settings}
    telling = {key for key in keys if len({canonical(other.setting(key)) for other in likes}) > 1}
    shown = {key: value for key, value in differences(run).items() if key in telling}
    return f"{run.algo.upper()}, {describe(shown)}" if shown else run.algo.upper()


def _identity(run: Run, without: str | None = None, algo: str | None = None) -> str:
    """
    Return a text that is equal for runs that differ only in their seed; an explicit default equals an omitted setting.

    :param without: a setting to leave out
    :param algo: the algorithm to assume instead of the run's
    """
    algo = algo or run.algo
    settings = {**default_settings(algo), **run.settings}
    return canonical([algo, run.env_id, {key: value for key, value in settings.items() if key != without}])


def _sortable(value: Any) -> tuple[bool, Any]:
    return (False, value) if isinstance(value, (bool, int, float)) else (True, str(value))
