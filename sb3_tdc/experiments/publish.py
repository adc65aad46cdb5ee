"""Copies of the small files of finished runs, in a folder that can be committed: all that the report reads.

A run keeps its relative path, so that the matrix finds its copy and does not train it again.
"""

import re
import shlex
import shutil
from os.path import abspath
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_tdc.common import plain_yaml
from sb3_tdc.experiments.final_episodes import read_test_returns
from sb3_tdc.experiments.results import Run, check_same_run, flatten
from sb3_tdc.runs.settings import RunSettings, flags_of

RESULTS = Path("results")
_SETTINGS = ("config.yml", "versions.yml", "finished.yml", "changes.yml")
# Rows of the log that are kept; more would show the same curve
_ROWS = 150
_COLUMNS = ("time/", "train/", "eval/", "board/", "rollout/ep_rew_mean")
_LEFT_OUT = ("time/fps", "time/episodes", "time/critics_elapsed")

# The flags of the log folder, and the pattern of a word that holds both the flag and the folder
_LOG_FOLDER = flags_of(RunSettings.__dataclass_fields__["log_folder"])
_JOINED = re.compile(rf"^(-f|(?:{'|'.join(_LOG_FOLDER)})=).+", re.DOTALL)


def publish(run: Run, logs: Path, folder: Path) -> Path:
    """
    Copy the small files of a finished run, with its log thinned and its log folder relative to ``logs``.

    Test returns are copied only if they belong to the current model. Files of an earlier copy that the run no longer
    has are removed.

    :param logs: a folder above the run, or the run's own
    :return: the folder of the copy
    :raises ValueError: if that folder holds anything but an earlier copy of the run
    """
    source, place = run.folder, folder / _place(run, logs)
    _check_is_copy(place, run)
    target = place / source.env_name
    target.mkdir(parents=True, exist_ok=True)
    _mirror(source.path / "evaluations.npz", place / "evaluations.npz")
    of_the_model = read_test_returns(run) is not None
    _mirror(source.test_returns, place / source.test_returns.name, of_the_model)
    for name in _SETTINGS:
        _mirror(source.path / source.env_name / name, target / name)
    if run.is_finished and source.steps_at_end is None:  # of RL Zoo, whose model, which is not copied, tells it
        (target / "finished.yml").write_text(plain_yaml.dump({"n_timesteps": run.steps}))
    relative = str(place.relative_to(folder).parents[1])
    arguments = {**source.args, "log_folder": relative}
    (target / "args.yml").write_text(plain_yaml.dump(arguments))
    command = _with_log_folder(_without_programs(run.command), relative)
    (target / "command.txt").write_text(f"{command}\n")
    (place / "progress.csv").unlink(missing_ok=True)
    if len(run.log):
        _thin(run.log).to_csv(place / "progress.csv", index=False, float_format="%.6g")
    return place


def _place(run: Run, logs: Path) -> Path:
    """Return the path of a run relative to a folder of runs: at least ``<algo>/<environment>_<number>``."""
    below = run.folder.path.relative_to(logs)
    return below if len(below.parts) > 1 else Path(*Path(abspath(run.folder.path)).parts[-2:])


def _check_is_copy(place: Path, run: Run) -> None:
    """
    Check that the run in a folder, if there is one, is an earlier copy of the run to publish.

    :raises ValueError: if it is another run
    """
    if not any(place.glob("*/args.yml")):
        return
    try:
        there = Run.open(place)
    except ValueError as error:
        raise ValueError(f"{error}; remove {place} to publish it again") from error
    if there.folder.model.is_file() or place.samefile(run.folder.path):
        raise ValueError(f"{place} is itself a run, not the copy of one: choose another folder")
    check_same_run(place, *(_identity(one, _may_differ(there) | _may_differ(run)) for one in (there, run)))


def _identity(run: Run, may_differ: set[str]) -> dict[str, Any]:
    settings = {"algo": run.algo, "env": run.env_id, "seed": run.seed, **run.settings}
    return {key: value for key, value in settings.items() if key not in may_differ}


def _may_differ(run: Run) -> set[str]:
    """Return the settings that may change, or have changed, when the run is resumed: it stays the same run."""
    return {"n_timesteps", "changes", *(key for each in run.folder.changes for key in flatten(each["hyperparams"]))}


def _mirror(source: Path, target: Path, is_valid: bool = True) -> None:
    """Copy a file; if it is missing or no longer valid, remove its earlier copy."""
    if source.is_file() and is_valid:
        shutil.copyfile(source, target)
    else:
        target.unlink(missing_ok=True)


def _without_programs(command: str) -> str:
    """Return a command without the paths of the interpreter and of the script."""
    words = shlex.split(command)
    programs = [Path(word).name for word in words[:2]]
    return shlex.join([*(programs[1:] if programs[1:] == ["sb3-tdc"] else programs), *words[2:]])


def _with_log_folder(command: str, folder: str) -> str:
    """Return a command with another log folder, if it names one."""
    words = shlex.split(command)
    return shlex.join(
        folder if before in _LOG_FOLDER else _JOINED.sub(lambda found: f"{found[1]}{folder}", word)
        for before, word in zip(["", *words], words, strict=False)
    )


def _thin(log: pd.DataFrame) -> pd.DataFrame:
    """
    Return the columns on training, timing and evaluations, with fewer rows.

    At most ``_ROWS`` rows are kept, and in addition every row with an evaluation.
    """
    columns = [name for name in log if str(name).startswith(_COLUMNS) and name not in _LEFT_OUT]
    evenly = np.unique(np.linspace(0, len(log) - 1, _ROWS).round().astype(int))
    evaluated = [name for name in log if str(name).startswith("eval/")]
    rows = set(evenly) | set(np.flatnonzero(log[evaluated].notna().any(axis=1)))
    return log.loc[sorted(rows), columns]
