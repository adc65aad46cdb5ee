"""Folders of runs (RL Zoo's layout) → arrays. Reads only; loads no model, and unpickles nothing."""

import inspect
import json
import re
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_tdc.algorithms import ALGORITHMS
from sb3_tdc.common.arrays import read_arrays
from sb3_tdc.hyperparams import hyperparams_file, read_entry
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.runs.settings import Role, defaults

# The part of a run that is late in training
_LATE = 1 / 3
# Settings that make another experiment of the same hyperparameters, and their defaults
_SETTINGS = defaults(Role.EXPERIMENT)


@dataclass(frozen=True)
class Evaluations:
    """
    The evaluations of one run.

    :param timesteps: (evaluations,)
    :param returns: (evaluations, episodes), of the mean action
    """

    timesteps: np.ndarray
    returns: np.ndarray


@dataclass(frozen=True)
class Run:
    """One seed: what ``sb3-tdc train`` was told, and what it left in its folder."""

    folder: RunFolder
    algo: str
    env_id: str
    seed: int
    settings: dict[str, Any]

    @classmethod
    def open(cls, path: Path) -> "Run":
        """
        Open the folder of a run, and read all of its files.

        :raises ValueError: if the folder is not one of a run
        """
        folder = RunFolder.open(path)
        try:
            args, config = folder.args, folder.config
            changed = {key: args[key] for key, default in _SETTINGS.items() if args.get(key, default) != default}
            if folder.changes:  # half of a run was of other hyperparameters
                changed["changes"] = folder.changes
            run = cls(
                folder,
                args["algo"],
                args["env"],
                args["seed"],
                _flatten({**config, "n_timesteps": folder.n_timesteps, **changed, **_simulator(folder.versions)}),
            )
            run.n_timesteps  # noqa: B018  # must be there
        except (OSError, KeyError, TypeError, AttributeError) as error:
            reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise ValueError(f"{path} has no readable config.yml and args.yml ({reason})") from error
        run._read_all()
        return run

    def _read_all(self) -> None:
        """
        Read all files now, so that a damaged one is known.

        :raises ValueError: if a file is truncated or damaged
        """
        try:
            _ = self.is_finished, self.evaluations, self.steps, self.system
        except (OSError, KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise ValueError(f"{self.folder.path} has a file that cannot be read ({reason})") from error

    def setting(self, key: str) -> Any:
        """Return a hyperparameter, or what is taken where none is given."""
        return self.settings.get(key, default_settings(self.algo).get(key))

    @property
    def n_timesteps(self) -> int:
        """Environment steps the run was to take."""
        return self.folder.n_timesteps

    @cached_property
    def steps(self) -> int:
        """Environment steps it has taken, as far as its files tell."""
        if self.folder.model.is_file():
            return self.folder.steps_of_model()
        if self.folder.steps_at_end is not None:
            return self.folder.steps_at_end
        progress = self.progress("time/total_timesteps")
        logged = progress[-1] if len(progress) else 0
        return int(max(logged, self.evaluations.timesteps[-1] if self.evaluations else 0))

    @cached_property
    def is_finished(self) -> bool:
        return self.folder.is_finished

    @property
    def is_complete(self) -> bool:
        """Return whether it has also taken all its steps: a callback may have ended it before."""
        return self.is_finished and self.steps >= self.n_timesteps

    @cached_property
    def evaluations(self) -> Evaluations | None:
        """None if it has not been evaluated."""
        path = self.folder.path / "evaluations.npz"
        if not path.is_file():
            return None
        return Evaluations(*read_arrays(path, "timesteps", "results"))

    def progress(self, *columns: str) -> np.ndarray:
        """
        Read columns of the log.

        :param columns: of ``progress.csv``
        :return: (rows,), or (rows, columns) of several, where all of them are known
        """
        nothing = np.empty((0, len(columns)))
        try:
            table = pd.read_csv(self.folder.path / "progress.csv")
        except (FileNotFoundError, pd.errors.EmptyDataError):
            table = pd.DataFrame()
        values = table[list(columns)].dropna().to_numpy() if set(columns) <= set(table) else nothing
        return values[:, 0] if len(columns) == 1 else values

    def late(self, column: str) -> np.ndarray:
        """Return the values of a column of the log in the last third of the run."""
        steps, values = self.progress("time/total_timesteps", column).T
        return values[self._is_late(steps)]

    def late_evaluations(self) -> np.ndarray:
        """Return the mean of each evaluation in the last third of the run."""
        if self.evaluations is None:
            return np.empty(0)
        return self.evaluations.returns.mean(axis=1)[self._is_late(self.evaluations.timesteps)]

    def _is_late(self, steps: np.ndarray) -> np.ndarray:
        return steps > (1 - _LATE) * self.n_timesteps

    @cached_property
    def system(self) -> str:
        """The versions and the commit it was trained with; of a run without these, what SB3 keeps in the model."""
        if versions := self.folder.versions:
            return " · ".join(f"{name} {value}" for name, value in versions.items())
        if not self.folder.model.is_file():
            return ""
        with zipfile.ZipFile(self.folder.model) as archive:
            lines = archive.read("system_info.txt").decode().splitlines()
        return " · ".join(line.lstrip("- ") for line in lines)

    @property
    def command(self) -> str:
        path = self.folder.path / self.folder.env_name / "command.txt"
        return path.read_text().strip() if path.is_file() else ""


@dataclass(frozen=True)
class Group:
    """
    Runs that differ in their seed alone.

    :param label: the algorithm, and in what it differs from the other groups of its algorithm and environment
    :param runs: at least one, in the order of their seeds
    """

    label: str
    runs: tuple[Run, ...]

    @property
    def algo(self) -> str:
        return self.runs[0].algo

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

    def setting(self, key: str) -> Any:
        return self.runs[0].setting(key)


def find_runs(folder: Path) -> tuple[list[Run], list[str]]:
    """
    Find every run below a folder.

    :return: every run below a folder, in the order of its path, and a sentence for each that cannot be read
    :raises ValueError: if there is none
    """
    runs, unreadable = [], []
    for path in sorted({config.parent.parent for config in folder.rglob("*/config.yml")}, key=_by_number):
        try:
            runs.append(Run.open(path))
        except ValueError as error:
            unreadable.append(str(error))
    if not runs:
        reasons = "; ".join(unreadable) or "no <algorithm>/<environment>_<number>/<environment>/config.yml"
        raise ValueError(f"There are no runs in {folder}: {reasons}")
    return runs, unreadable


def _by_number(path: Path) -> tuple[Path, str, int]:
    """Order folders as they were made: Hopper-v4_10 after Hopper-v4_9."""
    name, _, number = path.name.rpartition("_")
    return path.parent, name, int(number) if number.isdigit() else 0


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
    return sorted(groups, key=lambda g: (g.env_id, order.index(g.algo) if g.algo in order else 99, g.label))


def vary(groups: Sequence[Group], key: str) -> list[list[Group]]:
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


def differences(run: Run) -> dict[str, Any]:
    """Return the settings that are not those of this package's ``hyperparams/``, as they are in the run."""
    try:
        entry, _ = read_entry(hyperparams_file(run.algo), run.env_id)
    except ValueError:
        entry = {}
    shipped = Run(run.folder, run.algo, run.env_id, run.seed, _flatten(entry))
    return {
        key: run.setting(key)
        for key in {**shipped.settings, **run.settings}
        if _canonical(run.setting(key)) != _canonical(shipped.setting(key))
    }


def describe(settings: dict[str, Any]) -> str:
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


def _label(run: Run, representatives: Sequence[Run]) -> str:
    """The algorithm's name, and the settings that tell it from its likes and are not those of ``hyperparams/``."""
    alike = [other for other in representatives if (other.algo, other.env_id) == (run.algo, run.env_id)]
    keys = {key for other in alike for key in other.settings}
    telling = {key for key in keys if len({_canonical(other.setting(key)) for other in alike}) > 1}
    shown = {key: value for key, value in differences(run).items() if key in telling}
    return f"{run.algo.upper()}, {describe(shown)}" if shown else run.algo.upper()


def _simulator(versions: Mapping[str, str]) -> dict[str, str]:
    """Return which MuJoCo a run was made with: its contacts are others since 3.5 (docs/differences.md)."""
    version = re.match(r"(\d+)\.(\d+)", str(versions.get("mujoco", "")))
    return {"mujoco": "since 3.5" if tuple(map(int, version.groups())) >= (3, 5) else "before 3.5"} if version else {}


def _identity(run: Run, without: str | None = None, algo: str | None = None) -> str:
    """
    Everything but the seed; a default is the same whether it is given or not.

    :param without: a setting to leave out
    :param algo: as if it were of this algorithm
    """
    algo = algo or run.algo
    settings = {**default_settings(algo), **run.settings}
    return _canonical([algo, run.env_id, {key: value for key, value in settings.items() if key != without}])


@cache
def default_settings(algo: str) -> dict[str, Any]:
    """The defaults of the algorithm's constructor and of ``sb3-tdc train``."""
    parameters = inspect.signature(ALGORITHMS[algo]).parameters.values() if algo in ALGORITHMS else ()
    return {**{p.name: p.default for p in parameters if p.default is not p.empty}, **_SETTINGS}


def _canonical(value: Any) -> str:
    """A text that is the same for the same settings: 1 and 1.0 are."""

    def same(item: Any) -> Any:
        if isinstance(item, dict):
            return {key: same(item[key]) for key in item}
        if isinstance(item, (list, tuple)):
            return [same(one) for one in item]
        return float(item) if isinstance(item, int) and not isinstance(item, bool) else item

    return json.dumps(same(value), sort_keys=True, default=str)


def same_settings(one: Any, other: Any) -> bool:
    """Return whether two settings say the same: 1 and 1.0 do."""
    return _canonical(one) == _canonical(other)


def _sortable(value: Any) -> tuple[bool, Any]:
    return (False, value) if isinstance(value, (bool, int, float)) else (True, str(value))


def _flatten(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, dict) and value:
            flat.update(_flatten(value, f"{prefix}{key}."))
        else:
            flat[f"{prefix}{key}"] = value
    return flat
