"""Runs → groups of runs that may be averaged; which groups may be compared, and how they are named."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from sb3_tdc.experiments.results import (
    Run,
    canonical,
    default_settings,
    flatten,
    same_settings,
    shorten_warm_up,
)
from sb3_tdc.experiments.statistics import final_return
from sb3_tdc.hyperparams import hyperparams_file, read_entry
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS

EVALUATION = ("eval_freq", "eval_episodes")
# The length of a run, its evaluations and its simulator: not hyperparameters of the algorithm
_NOT_HYPERPARAMETERS = {"n_timesteps", *EVALUATION, "mujoco"}


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

    :param runs: at least one run, in the order of their seeds
    :param distinguishing: the settings that differ from ``hyperparams/`` and vary among groups of the same algorithm
        under the same conditions
    """

    runs: tuple[Run, ...]
    distinguishing: Mapping[str, Any] = field(default_factory=dict, compare=False)

    @property
    def label(self) -> str:
        """The algorithm, and the settings that distinguish the group under its conditions."""
        return _named(self.algo, self.distinguishing)

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
        """The label with all hyperparameters that differ from ``hyperparams/``: for tables of many tasks."""
        differing = hyperparameters_not_shipped(self.runs[0]) if _shipped(self.algo, self.env_id) else {}
        return _named(self.algo, {**differing, **self.distinguishing})

    @property
    def commits(self) -> tuple[str, ...]:
        """The commits of this package that the finished runs were trained with."""
        return tuple(dict.fromkeys(run.folder.versions.get("sb3_tdc", "") for run in self.finished))

    @property
    def is_as_shipped(self) -> bool:
        return is_as_shipped(self.runs[0])

    @property
    def has_whole_warm_up(self) -> bool:
        """Return whether the warm-up is that of ``hyperparams/``, which the matrix shortens in a short run."""
        warm_up = _shipped(self.algo, self.env_id).get("learning_starts")
        return warm_up is None or self.setting("learning_starts") == warm_up

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
    groups = [Group(group, _distinguishing(group[0], [other[0] for other in members])) for group in members]
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
        found.setdefault(_identity(group.runs[0], without={key}), []).append(group)
    return [sorted(some, key=lambda g: _sortable(g.setting(key))) for some in found.values() if len(some) > 1]


def have_same_settings(one: Group, other: Group, but: Collection[str] = ()) -> bool:
    """
    Return whether two groups have the same settings, even if their algorithms differ.

    :param but: settings that may differ
    """
    return _identity(one.runs[0], but, algo=other.algo) == _identity(other.runs[0], but)


def as_shipped(groups: Iterable[Group]) -> list[Group]:
    """
    Return one group for each algorithm, with the hyperparameters of ``hyperparams/``.

    :param groups: groups under the same conditions. If several of an algorithm differ in their warm-up, the choice is
        the same for all algorithms where possible; if they differ in their evaluations, the one with the most finished
        seeds is taken
    """
    shipped = [group for group in groups if group.is_as_shipped]
    with_whole, with_short = (
        {group.algo for group in shipped if group.finished and group.has_whole_warm_up == whole}
        for whole in (True, False)
    )
    prefers_whole = len(with_whole) >= len(with_short)

    def rank(group: Group) -> tuple[bool, bool, int]:
        return bool(group.finished), group.has_whole_warm_up == prefers_whole, len(group.finished)

    algos = dict.fromkeys(group.algo for group in shipped)
    return [max((group for group in shipped if group.algo == algo), key=rank) for algo in algos]


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
    if warm_up is not None and run.setting("learning_starts") == shorten_warm_up(warm_up, run.n_timesteps):
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


def _named(algo: str, settings: Mapping[str, Any]) -> str:
    return f"{algo.upper()}, {describe(settings)}" if settings else algo.upper()


def _distinguishing(run: Run, representatives: Sequence[Run]) -> dict[str, Any]:
    """
    Return the settings of a run that differ from ``hyperparams/`` and vary among its likes.

    :param representatives: one run of every group; its likes have its algorithm and conditions
    """
    likes = [o for o in representatives if o.algo == run.algo and _conditions(o) == _conditions(run)]
    keys = {key for other in likes for key in other.settings}
    telling = {key for key in keys if len({canonical(other.setting(key)) for other in likes}) > 1}
    return {key: value for key, value in differences(run).items() if key in telling}


def _identity(run: Run, without: Collection[str] = (), algo: str | None = None) -> str:
    """
    Return a text that is equal for runs that differ only in their seed; an explicit default equals an omitted setting.

    :param without: settings to leave out
    :param algo: the algorithm to assume instead of the run's
    """
    algo = algo or run.algo
    settings = {**default_settings(algo), **run.settings}
    return canonical([algo, run.env_id, {key: value for key, value in settings.items() if key not in without}])


def _sortable(value: Any) -> tuple[bool, Any]:
    return (False, value) if isinstance(value, (bool, int, float)) else (True, str(value))
