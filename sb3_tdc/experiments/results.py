"""Folders of runs (RL Zoo's layout) → settings and arrays. Only reads files; loads no model, unpickles nothing."""

import json
import os
import re
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd

from sb3_tdc.common.signatures import constructor_parameters
from sb3_tdc.envs.registry import simulator_of
from sb3_tdc.envs.simulator import GYMNASIUM
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS
from sb3_tdc.runs.evaluations import Evaluations, read_evaluations
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.runs.settings import Role, defaults
from sb3_tdc.safe_load import read_system_info

# The last part of a run that counts as late in training
_LATE = 1 / 3
# Settings that make another experiment even with the same hyperparameters, and their defaults
_SETTINGS = defaults(Role.EXPERIMENT)


@dataclass(frozen=True)
class Run:
    """A run of one seed: the settings given to ``sb3-tdc train``, and the files in its folder."""

    folder: RunFolder
    algo: str
    env_id: str
    seed: int
    settings: dict[str, Any]

    @classmethod
    def open(cls, path: Path) -> "Run":
        """
        Open the folder of a run, and read all of its files.

        :raises ValueError: if the folder is not that of a run, or a file in it cannot be read
        """
        folder = RunFolder.open(path)
        try:
            args, config = folder.args, folder.config
            changed = {key: args[key] for key, default in _SETTINGS.items() if args.get(key, default) != default}
            if folder.changes:  # a part of the run had other hyperparameters
                changed["changes"] = folder.changes
            run = cls(
                folder,
                args["algo"],
                args["env"],
                args["seed"],
                flatten(
                    {**config, "n_timesteps": folder.n_timesteps, **changed, **_physics(args["env"], folder.versions)}
                ),
            )
            run.n_timesteps  # noqa: B018  # must be there
            if not all(isinstance(text, str) for text in (run.algo, run.env_id)) or type(run.seed) is not int:
                raise TypeError(f"algo {run.algo!r}, env {run.env_id!r} or seed {run.seed!r} is of another type")
        except (OSError, KeyError, TypeError, AttributeError) as error:
            reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise ValueError(f"{path} has no readable config.yml and args.yml ({reason})") from error
        run._read_all()
        return run

    def _read_all(self) -> None:
        """
        Read all files now, so that a damaged one is found before anything is averaged.

        :raises ValueError: if a file is truncated or damaged
        """
        try:
            _ = self.is_finished, self.evaluations, self.log, self.steps, self.system
        except (OSError, KeyError, TypeError, ValueError) as error:
            reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise ValueError(f"{self.folder.path} has a file that cannot be read ({reason})") from error

    def setting(self, key: str) -> Any:
        """Return the value of a setting, or its default if none is given."""
        return self.settings.get(key, default_settings(self.algo).get(key))

    @cached_property
    def n_timesteps(self) -> int:
        """Environment steps that the run was to take."""
        return self.folder.n_timesteps

    @cached_property
    def steps(self) -> int:
        """Environment steps that the run has taken, as far as its files tell."""
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
        """Return whether the run is finished and has taken all its steps: a callback may have ended it earlier."""
        return self.is_finished and self.steps >= self.n_timesteps

    @property
    def is_averaged(self) -> bool:
        """Return whether the run is complete and has evaluations, all with finite returns."""
        return self.is_complete and self.evaluations is not None and bool(np.isfinite(self.evaluations.returns).all())

    @cached_property
    def evaluations(self) -> Evaluations | None:
        """The evaluations; None if the run has not been evaluated."""
        return read_evaluations(self.folder)

    @cached_property
    def log(self) -> pd.DataFrame:
        """``progress.csv``, empty if there is none."""
        try:
            return pd.read_csv(self.folder.path / "progress.csv")
        except (FileNotFoundError, pd.errors.EmptyDataError):
            return pd.DataFrame()

    def progress(self, *columns: str) -> np.ndarray:
        """
        Read columns of the log.

        :param columns: names of columns in ``progress.csv``
        :return: (rows,) for one column, (rows, columns) for several; only rows in which all of them have a value
        """
        log = self.log
        values = log[list(columns)].dropna().to_numpy() if set(columns) <= set(log) else np.empty((0, len(columns)))
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
        """The versions and the commit that the run was trained with; without these, what SB3 keeps in the model."""
        if versions := self.folder.versions:
            return " · ".join(f"{name} {value}" for name, value in versions.items())
        if not self.folder.model.is_file():
            return ""
        lines = read_system_info(self.folder.model).splitlines()
        return " · ".join(line.lstrip("- ") for line in lines)

    @property
    def command(self) -> str:
        path = self.folder.path / self.folder.env_name / "command.txt"
        return path.read_text().strip() if path.is_file() else ""


def find_runs(*folders: Path) -> tuple[list[Run], list[str]]:
    """
    Find every run below some folders, following symbolic links.

    :return: the runs, folder after folder, ordered by path, and one sentence for each run that cannot be read
    :raises ValueError: if there is no run below one of the folders, or none can be read
    """
    runs, unreadable, seen = [], [], set()
    for folder in folders:
        configs = (below / "config.yml" for below in _folders_below(folder))
        paths = sorted({config.parents[1] for config in configs if config.is_file()}, key=_by_number)
        if not paths:
            reason = "no <algorithm>/<environment>_<number>/<environment>/config.yml"
            raise ValueError(f"There are no runs in {folder}: {reason}")
        for path in paths:
            if (real := path.resolve()) in seen:
                continue
            seen.add(real)
            try:
                runs.append(Run.open(path))
            except ValueError as error:
                unreadable.append(str(error))
    if not runs:
        raise ValueError(f"There are no runs in {', '.join(map(str, folders))}: {'; '.join(unreadable)}")
    return runs, unreadable


def _folders_below(folder: Path) -> Iterator[Path]:
    """Yield every folder below one, once. Links are followed last, so that folders below it keep their own paths."""
    waiting, seen = deque([folder]), set()
    while waiting:
        for name, folders, _ in os.walk(waiting.popleft()):
            path = Path(name)
            if (real := path.resolve()) in seen:
                folders.clear()
                continue
            seen.add(real)
            waiting.extend(path / each for each in sorted(folders) if (path / each).is_symlink())
            if path != folder:
                yield path


def _by_number(path: Path) -> tuple[Path, str, int]:
    """Return a sort key by the number in the name: Hopper-v4_10 comes after Hopper-v4_9."""
    name, _, number = path.name.rpartition("_")
    return path.parent, name, int(number) if number.isdigit() else 0


def _physics(env_id: str, versions: Mapping[str, str]) -> dict[str, str]:
    """Return the setting ``mujoco`` of a task that may use MuJoCo: contacts differ since 3.5 (docs/differences.md)."""
    version = re.match(r"(\d+)\.(\d+)", str(versions.get("mujoco", "")))
    if not _may_use_mujoco(env_id):
        return {}
    if version is None:
        return {"mujoco": "of unknown version"}
    return {"mujoco": "since 3.5" if tuple(map(int, version.groups())) >= (3, 5) else "before 3.5"}


def _may_use_mujoco(env_id: str) -> bool:
    """Return whether a task may use MuJoCo; PyBullet's, Isaac Lab's and Gymnasium's other tasks do not."""
    if simulator_of(env_id) is not GYMNASIUM:
        return False
    entry_point = str(gym.registry[env_id].entry_point) if env_id in gym.registry else ""
    return not entry_point.startswith("gymnasium.envs.") or entry_point.startswith("gymnasium.envs.mujoco.")


@cache
def default_settings(algo: str) -> dict[str, Any]:
    """Return the defaults of the algorithm's constructor and of ``sb3-tdc train``."""
    parameters = constructor_parameters(KNOWN_ALGORITHMS[algo]).values() if algo in KNOWN_ALGORITHMS else ()
    return {**{p.name: p.default for p in parameters if p.default is not p.empty}, **_SETTINGS}


def shorten_warm_up(learning_starts: int, n_timesteps: int) -> int:
    """Return the warm-up of a run of the matrix: that of ``hyperparams/``, but at most a tenth of the run."""
    return min(learning_starts, n_timesteps // 10)


def canonical(value: Any) -> str:
    """Return a canonical text of settings, in which 1 equals 1.0."""

    def same(item: Any) -> Any:
        if isinstance(item, dict):
            return {key: same(item[key]) for key in item}
        if isinstance(item, (list, tuple)):
            return [same(one) for one in item]
        return float(item) if isinstance(item, int) and not isinstance(item, bool) else item

    return json.dumps(same(value), sort_keys=True, default=str)


def same_settings(one: Any, other: Any) -> bool:
    """Return whether two settings are equal; 1 equals 1.0."""
    return canonical(one) == canonical(other)


def check_same_run(path: Path, here: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """
    Check that the run in a folder is the wanted run.

    :param here: settings of the run in the folder
    :param wanted: settings of the wanted run
    :raises ValueError: if it is another run; the message names the settings that differ
    """
    differing = [key for key in {**here, **wanted} if not same_settings(here.get(key), wanted.get(key))]
    if differing:
        what = ", ".join(f"{key} {here.get(key)} instead of {wanted.get(key)}" for key in differing)
        raise ValueError(f"{path} is another run ({what}): move it away, or choose another folder")


def flatten(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested settings: ``{"policy_kwargs": {"n_quantiles": 64}}`` → ``{"policy_kwargs.n_quantiles": 64}``."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, dict) and value:
            flat.update(flatten(value, f"{prefix}{key}."))
        else:
            flat[f"{prefix}{key}"] = value
    return flat
