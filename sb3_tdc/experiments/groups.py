"""Runs → groups that may be averaged, what may be compared with what, and how it is named."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_tdc.algorithms import ALGORITHMS
from sb3_tdc.experiments.results import Run, canonical, default_settings, flatten
from sb3_tdc.experiments.statistics import final_return
from sb3_tdc.hyperparams import hyperparams_file, read_entry

# The length of a run and how it is looked at: no hyperparameters of the algorithm
_NOT_HYPERPARAMETERS = {"n_timesteps", "eval_freq", "eval_episodes", "mujoco"}


@dataclass(frozen=True, order=True)
class Conditions:
    """
    What runs have in common that are compared with each other, and drawn in one figure.

    :param mujoco: "before 3.5" or "since 3.5", which move Hopper, Ant and Humanoid otherwise; "" where it is not known,
        or does not matter
    """

    env_id: str
    n_timesteps: int
    mujoco: str = ""

    def __str__(self) -> str:
        return f"{self.task}, {self.n_timesteps:,} steps"

    @property
    def task(self) -> str:
        """The environment, and MuJoCo's version where published returns were made with another one."""
        return f"{self.env_id}, MuJoCo {self.mujoco}" if self.mujoco.startswith("since") else self.env_id

    @property
    def file_name(self) -> str:
        version = "-mujoco-since-3.5" if self.mujoco.startswith("since") else ""
        return f"{self.env_id}-{self.n_timesteps}{version}"


@dataclass(frozen=True)
class Group:
    """
    Runs that differ in their seed alone.

    :param label: the algorithm, and in what it differs from the other groups of its algorithm and conditions
    :param runs: at least one, in the order of their seeds
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
        """Those that took all their steps and were evaluated: the only ones that are averaged."""
        return tuple(run for run in self.runs if run.is_complete and run.evaluations)

    @property
    def seeds(self) -> str:
        """How many, and which."""
        numbers = ", ".join(str(run.seed) for run in self.finished)
        return f"{len(self.finished)} ({numbers})" if numbers else "0"

    @property
    def final_returns(self) -> np.ndarray:
        """(runs,), the mean of the last evaluation of every finished run"""
        return np.array([final_return(run.evaluations.returns) for run in self.finished if run.evaluations])

    @property
    def late_returns(self) -> np.ndarray:
        """(runs,), the mean of the evaluations in the last third of every finished run"""
        return np.array([run.late_evaluations().mean() for run in self.finished])

    @property
    def shipped_steps(self) -> int:
        """Environment steps of the hyperparameter file, those of the paper for its tasks; 0 if there is no file."""
        entry = _shipped(self.algo, self.env_id)
        return entry.get("n_timesteps", 0)

    @property
    def commits(self) -> tuple[str, ...]:
        """Those of this package that its finished runs were trained with."""
        return tuple(dict.fromkeys(run.folder.versions.get("sb3_tdc", "") for run in self.finished))

    @property
    def is_as_shipped(self) -> bool:
        return is_as_shipped(self.runs[0])

    def setting(self, key: str) -> Any:
        return self.runs[0].setting(key)


def group_runs(runs: Iterable[Run]) -> list[Group]:
    """
    Put together what may be averaged: runs of one algorithm and environment that differ in their seed alone.

    A second run of one seed is a repetition, not another seed: of several, the last finished one stays.
    """
    found: dict[str, dict[int, Run]] = {}
    for run in runs:
        seeds = found.setdefault(_identity(run), {})
        if run.seed not in seeds or run.is_finished or not seeds[run.seed].is_finished:
            seeds[run.seed] = run
    members = [tuple(seeds[seed] for seed in sorted(seeds)) for seeds in found.values()]
    groups = [Group(_label(group[0], [other[0] for other in members]), group) for group in members]
    order = list(ALGORITHMS)
    return sorted(groups, key=lambda g: (g.conditions, order.index(g.algo) if g.algo in order else 99, g.label))


def by_conditions(groups: Iterable[Group], tasks: Sequence[str] = ()) -> dict[Conditions, list[Group]]:
    """
    Put together what is compared.

    :param tasks: environments that come first, in this order; the others follow by name
    """
    found: dict[Conditions, list[Group]] = {}
    for group in groups:
        found.setdefault(group.conditions, []).append(group)
    order = {env_id: place for place, env_id in enumerate(tasks)}
    return dict(sorted(found.items(), key=lambda item: (order.get(item[0].env_id, len(order)), item[0])))


def vary(groups: Iterable[Group], key: str) -> list[list[Group]]:
    """
    The ablations of one hyperparameter.

    :return: lists of at least two groups that differ in ``key`` alone, ordered by it
    """
    found: dict[str, list[Group]] = {}
    for group in groups:
        found.setdefault(_identity(group.runs[0], without=key), []).append(group)
    return [sorted(some, key=lambda g: _sortable(g.setting(key))) for some in found.values() if len(some) > 1]


def is_same_but(what: str, one: Group, other: Group) -> bool:
    """Return whether two groups differ at most in one setting, or, for "algo", in the algorithm alone."""
    if what == "algo":
        return _identity(one.runs[0], algo=other.algo) == _identity(other.runs[0])
    return _identity(one.runs[0], without=what) == _identity(other.runs[0], without=what)


def is_as_shipped(run: Run, but: Iterable[str] = ()) -> bool:
    """
    Return whether a run has the hyperparameters of this package's ``hyperparams/``, whatever its length.

    The matrix shortens a warm-up to a tenth of a short run.

    :param but: settings that may be others
    """
    differing = set(differences(run)) - _NOT_HYPERPARAMETERS - set(but)
    is_shortened = run.setting("learning_starts") == run.n_timesteps // 10
    return not differing - ({"learning_starts"} if is_shortened else set())


def differences(run: Run) -> dict[str, Any]:
    """Return the settings that are not those of this package's ``hyperparams/``, as they are in the run."""
    shipped = Run(run.folder, run.algo, run.env_id, run.seed, _shipped(run.algo, run.env_id))
    return {
        key: run.setting(key)
        for key in {**shipped.settings, **run.settings}
        if canonical(run.setting(key)) != canonical(shipped.setting(key))
    }


def shared_differences(groups: Sequence[Group]) -> str:
    """
    Say what all groups of an algorithm have other than ``hyperparams/``: their labels name only what tells them apart.

    :return: ``"All TDC: tau 0.01; all TD3: batch_size 64."``, "" if there is nothing to say
    """
    said = []
    for algo in dict.fromkeys(group.algo for group in groups):
        found = [differences(group.runs[0]) for group in groups if group.algo == algo]
        common = {
            key: value
            for key, value in found[0].items()
            if key not in _NOT_HYPERPARAMETERS and all(canonical(o.get(key)) == canonical(value) for o in found)
        }
        if common:
            said.append(f"all {algo.upper()}: {describe(common)}")
    text = "; ".join(said)
    return f"{text[0].upper()}{text[1:]}." if text else ""


def describe(settings: Mapping[str, Any]) -> str:
    """``{"lam": 0.5, "tau": 0.01}`` → "λ 0.5, tau 0.01"."""
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


def _shipped(algo: str, env_id: str) -> dict[str, Any]:
    try:
        return flatten(read_entry(hyperparams_file(algo), env_id)[0])
    except ValueError:  # of another package
        return {}


def _conditions(run: Run) -> Conditions:
    return Conditions(run.env_id, run.n_timesteps, run.setting("mujoco") or "")


def _label(run: Run, representatives: Sequence[Run]) -> str:
    """The algorithm's name, and the settings that tell it from its likes and are not those of ``hyperparams/``."""
    likes = [o for o in representatives if o.algo == run.algo and _conditions(o) == _conditions(run)]
    keys = {key for other in likes for key in other.settings}
    telling = {key for key in keys if len({canonical(other.setting(key)) for other in likes}) > 1}
    shown = {key: value for key, value in differences(run).items() if key in telling}
    return f"{run.algo.upper()}, {describe(shown)}" if shown else run.algo.upper()


def _identity(run: Run, without: str | None = None, algo: str | None = None) -> str:
    """
    Everything but the seed; a default is the same whether it is given or not.

    :param without: a setting to leave out
    :param algo: as if it were of this algorithm
    """
    algo = algo or run.algo
    settings = {**default_settings(algo), **run.settings}
    return canonical([algo, run.env_id, {key: value for key, value in settings.items() if key != without}])


def _sortable(value: Any) -> tuple[bool, Any]:
    return (False, value) if isinstance(value, (bool, int, float)) else (True, str(value))
