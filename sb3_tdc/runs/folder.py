"""The folder with the files of a run, in RL Zoo's layout: ``logs/tdc/Walker2d-v4_1/…``."""

import re
import shlex
import shutil
import sys
import uuid
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sb3_tdc.common import plain_yaml
from sb3_tdc.common.checks import suggest
from sb3_tdc.common.commands import command
from sb3_tdc.common.files import make_numbered, numbered, write_atomically
from sb3_tdc.common.saved_fields import integer
from sb3_tdc.common.versions import commit_of_the_code, library_versions, processor_name
from sb3_tdc.safe_load import read_data
from sb3_tdc.safe_load.regular_files import read_text

_MAX_YAML = 2**18  # bytes; the files of train.py and RL Zoo have a few thousand
_CHECKPOINT = re.compile(r"rl_model_(\d+)_steps\.zip")


@dataclass(frozen=True)
class RunFolder:
    """
    The files of one run.

    :param path: ``<log folder>/<algo>/<environment>_<number>``
    :param env_name: the environment's id, without slashes
    :param outermost: the outermost folder that was made for the run; None if the run was opened
    """

    path: Path
    env_name: str
    outermost: Path | None = field(default=None, compare=False)

    @classmethod
    def create(cls, log_folder: str | Path, algo: str, env_id: str, unique: bool = False) -> "RunFolder":
        """
        Make the folder with the next free number; two runs that start at the same time get different ones.

        :param unique: append a UUID to the name
        """
        env_name, parent = folder_name(env_id), Path(log_folder) / algo
        missing = [each for each in (parent, *parent.parents) if not each.exists()]
        path = make_numbered(parent, env_name, f"_{uuid.uuid4()}" if unique else "")
        (path / env_name).mkdir()
        return cls(path, env_name, outermost=missing[-1] if missing else path)

    def remove(self) -> None:
        """Remove the folder of a run that never began, and the parent folders made for it, if they are empty."""
        shutil.rmtree(self.path, ignore_errors=True)
        made = (each for each in self.path.parents if self.outermost and each.is_relative_to(self.outermost))
        with suppress(OSError):  # a parent is not empty
            for parent in made:
                parent.rmdir()

    @classmethod
    def find(cls, log_folder: str | Path, algo: str, env_id: str, number: int = 0) -> "RunFolder":
        """
        Find a run in a log folder.

        :param number: number of the run; 0 for the latest
        :raises ValueError: if there is no such run
        """
        env_name, parent = folder_name(env_id), Path(log_folder) / algo
        runs = numbered(parent, env_name)
        if not runs or (number and number not in runs):
            known = f"; there are {', '.join(map(str, sorted(runs)))}" if runs else suggest(env_id, _env_names(parent))
            wanted = f"run {number} of" if number else "run of"
            raise ValueError(f"There is no {wanted} {algo} on {env_id} in {parent}{known}")
        return cls(runs[number or max(runs)], env_name)

    @classmethod
    def open(cls, path: str | Path) -> "RunFolder":
        """
        Open the folder of a run.

        :raises ValueError: if the folder is not a run folder
        """
        path = Path(path)
        if not path.exists():
            raise ValueError(f"{path} does not exist")
        configs = list(path.glob("*/config.yml"))
        if len(configs) != 1:
            raise ValueError(f"{path} is not the folder of a run: it has no <environment>/config.yml")
        return cls(path, configs[0].parent.name)

    @classmethod
    def around(cls, model: Path, env_id: str) -> "RunFolder":
        """
        Return the folder that contains a model. It need not be a run folder, and the model may have been copied there.

        :param env_id: environment of the model; used in file names if the folder is not a run folder
        """
        try:
            return cls.open(model.parent)
        except ValueError:
            return cls(model.parent, folder_name(env_id))

    @property
    def model(self) -> Path:
        return self.path / f"{self.env_name}.zip"

    @property
    def best_model(self) -> Path:
        return self.path / "best_model.zip"

    @property
    def evaluations(self) -> Path:
        return self.path / "evaluations.npz"

    @property
    def test_returns(self) -> Path:
        """The returns of the final model in ``sb3-tdc evaluate``."""
        return self.path / "test_returns.npz"

    @property
    def trained_agent(self) -> Path:
        """The copy of the model that the run started from; a resumed run is built from it."""
        return self.path / self.env_name / "trained_agent.zip"

    def copy_trained_agent(self, model: Path, normalization: Path | None, replay_buffer: Path) -> None:
        """
        Copy the model that the run starts from.

        :param normalization: its statistics of ``VecNormalize``, if it has any
        :param replay_buffer: its replay buffer, which may be missing; it is too large to be copied
        """
        shutil.copyfile(model, self.trained_agent)
        if normalization is not None:
            shutil.copyfile(normalization, self.normalization(self.trained_agent))
        if replay_buffer.is_file():
            written = {"path": str(replay_buffer.absolute()), "modified": replay_buffer.stat().st_mtime_ns}
            _write_text(self._experience, plain_yaml.dump(written))

    @property
    def experience(self) -> Path | None:
        """
        The replay buffer of the model that the run started from; None if none was saved with it.

        :raises ValueError: if the replay buffer is missing by now, or has been written again
        """
        if not self._experience.is_file():
            return None
        written = _read_yaml(self._experience)
        path = Path(written["path"])
        if not path.is_file() or path.stat().st_mtime_ns != written["modified"]:
            raise ValueError(
                f"{path}, the replay buffer that the run started from, is missing or has changed: "
                f"put it back, or start a new run with -i {self.trained_agent}"
            )
        return path

    @property
    def _experience(self) -> Path:
        return self.path / self.env_name / "trained_agent_replay_buffer.yml"

    @property
    def config(self) -> dict[str, Any]:
        """The hyperparameters as given, before they are parsed."""
        return _read_yaml(self._config)

    @property
    def normalize(self) -> Any:
        """The hyperparameter ``normalize`` as given; None if this is not the folder of a run."""
        return self.config.get("normalize", False) if self._config.is_file() else None

    @property
    def args(self) -> dict[str, Any]:
        """The command line arguments."""
        return _read_yaml(self.path / self.env_name / "args.yml")

    @property
    def resume_folder(self) -> Path:
        """The folder of the resume states."""
        return self.path / "resume"

    @property
    def error(self) -> Path:
        """The file with the traceback of the exception that ended training."""
        return self.path / self.env_name / "error.txt"

    def write_error(self, text: str) -> None:
        """Write a traceback; a full disk is ignored."""
        with suppress(OSError):
            _write_text(self.error, text)

    @property
    def command_to_resume(self) -> str:
        return command("train", "--resume", self.path)

    @property
    def has_results(self) -> bool:
        """Return whether the run has results that would be overwritten if it began at step 0 again."""
        headers = {log: 1 if log.name == "progress.csv" else 2 for log in self._logs()}  # lines
        has_rows = any(log.read_bytes().count(b"\n") > header for log, header in headers.items())
        return has_rows or any(self.path.glob("*.zip")) or self.evaluations.is_file()

    def _logs(self) -> list[Path]:
        return [log for log in (*self.path.glob("*monitor.csv"), self.path / "progress.csv") if log.is_file()]

    def take_logs(self) -> dict[Path, bytes]:
        """Remove the logs of episodes and of training, and return their contents."""
        logs = {path: path.read_bytes() for path in self._logs()}
        for path in logs:
            path.unlink()
        return logs

    def put_back(self, logs: dict[Path, bytes]) -> None:
        """Replace the logs by those that were taken."""
        self.take_logs()
        for path, content in logs.items():
            path.write_bytes(content)

    def results(self) -> list[Path]:
        """Return the paths of everything that training leaves, except the logs that it opens anew (``take_logs``)."""
        records = [self.evaluations, self.error, self._finished, self._changes]
        events = self.path.glob("events.out.tfevents.*")
        models = (self.model, self.best_model, *self.checkpoints().values())
        return [*records, *events, *(path for model in models for path in self.files_of(model))]

    def files_of(self, model: Path) -> list[Path]:
        """Return the path of one of the run's models, and the paths of the files that belong to it."""
        of_the_final_model = [self.test_returns] if model == self.model else []
        return [model, self.normalization(model), self.replay_buffer(model), *of_the_final_model]

    @property
    def n_timesteps(self) -> int:
        """The planned number of environment steps. In a run of RL Zoo, ``-n`` is not among the hyperparameters."""
        given = self.args.get("n_timesteps") if self._is_of_rl_zoo else None
        return int(given if isinstance(given, int) and given > 0 else self.config["n_timesteps"])

    @property
    def _is_of_rl_zoo(self) -> bool:
        return "resume_freq" not in self.args

    @property
    def versions(self) -> dict[str, str]:
        """The versions, the commit and the processor that the run began with; empty for a run of RL Zoo."""
        path = self.path / self.env_name / "versions.yml"
        return _read_yaml(path) if path.is_file() else {}

    @property
    def steps_at_end(self) -> int | None:
        """The environment steps that a finished run has taken; None if it is unfinished or a run of RL Zoo."""
        return int(_read_yaml(self._finished)["n_timesteps"]) if self._finished.is_file() else None

    @property
    def is_finished(self) -> bool:
        """
        Whether training ended at the last step or by a callback, and not by an interruption.

        :raises ValueError: if the model of a run of RL Zoo cannot be read
        """
        if self._finished.is_file():
            return True
        # RL Zoo does not record it: its run is finished if the model has all steps and was not started over since
        may_be_finished = self._is_of_rl_zoo and not self.resume_folder.exists()
        return may_be_finished and self.model.is_file() and self.steps_of_model() >= self.n_timesteps

    def steps_of_model(self) -> int:
        """
        Return the number of environment steps that the final model was trained for.

        :raises ValueError: if the model cannot be read
        """
        steps = read_data(self.model).get("num_timesteps")
        return integer(0)(f"{self.model}: num_timesteps", steps)

    @property
    def _config(self) -> Path:
        return self.path / self.env_name / "config.yml"

    @property
    def _finished(self) -> Path:
        return self.path / self.env_name / "finished.yml"

    def mark_finished(self, n_timesteps: int) -> None:
        """Record that training has ended and the model is saved."""
        _write_text(self._finished, plain_yaml.dump({"n_timesteps": n_timesteps}))

    def checkpoints(self) -> dict[int, Path]:
        """Return the models of ``--save-freq``, by timestep, oldest first."""
        found = {}
        for path in self.path.glob("rl_model_*_steps.zip"):
            if match := _CHECKPOINT.fullmatch(path.name):
                found[int(match[1])] = path
        return dict(sorted(found.items()))

    def saved_files(self) -> list[Path]:
        """Return all zips of models, then all pickles: statistics of ``VecNormalize`` and replay buffers."""
        folders = (self.path, self.path / self.env_name)
        return [file for end in ("zip", "pkl") for folder in folders for file in sorted(folder.glob(f"*.{end}"))]

    def normalization(self, model: Path) -> Path:
        """Return the path of the ``VecNormalize`` statistics of one of the run's models."""
        if model.name == self.best_model.name:
            return self.path / "best_model_vecnormalize.pkl"
        if model.name == self.trained_agent.name:
            return model.with_name("trained_agent_vecnormalize.pkl")
        if match := _CHECKPOINT.fullmatch(model.name):
            return self.path / f"rl_model_vecnormalize_{match[1]}_steps.pkl"
        return self.path / self.env_name / "vecnormalize.pkl"

    def find_normalization(self, model: Path) -> Path | None:
        """
        Find the ``VecNormalize`` statistics of one of the run's models, or else those of its final model.

        :return: their path; None if the run was trained without normalisation
        :raises ValueError: if the run was trained with normalisation, and there are no statistics
        """
        # RL Zoo keeps one file for all models of a run
        found = next((path for path in map(self.normalization, (model, self.model)) if path.is_file()), None)
        if found is None and self.normalize:
            missing = self.normalization(self.model)
            raise ValueError(f"{missing} is missing: {model.name} was trained on normalised observations")
        return found

    def replay_buffer(self, model: Path) -> Path:
        """Return the path of the replay buffer of one of the run's models."""
        if match := _CHECKPOINT.fullmatch(model.name):
            return self.path / f"rl_model_replay_buffer_{match[1]}_steps.pkl"
        if model.name == self.best_model.name:
            return self.path / "best_model_replay_buffer.pkl"  # never saved
        return self.path / "replay_buffer.pkl"

    @property
    def changes(self) -> list[dict[str, Any]]:
        """The changes made when the run was resumed: the step of each, and the hyperparameters from there on."""
        path = self._changes
        return _read_yaml(path)["changes"] if path.is_file() else []

    @property
    def _changes(self) -> Path:
        return self.path / self.env_name / "changes.yml"

    def record_change(self, step: int, config: dict[str, Any], names: tuple[str, ...]) -> None:
        """
        Store hyperparameters that change at a step.

        :param config: all hyperparameters, with their new values
        :param names: the changed ones that turn the run into another experiment, if any
        """
        if names:
            change = {"step": step, "hyperparams": {name: config[name] for name in names}}
            _write_text(self._changes, plain_yaml.dump({"changes": [*self.changes, change]}))
        _write_text(self._config, plain_yaml.dump(config))

    def record_length(self, n_timesteps: int) -> None:
        """Store the new planned number of timesteps in ``args.yml``; ``config.yml`` has it too."""
        _write_text(self.path / self.env_name / "args.yml", plain_yaml.dump({**self.args, "n_timesteps": n_timesteps}))

    def write_config(self, config: dict[str, Any], args: dict[str, Any]) -> None:
        """Write the files that describe the run: command, hyperparameters, arguments, versions and commit."""
        folder = self.path / self.env_name
        _write_text(folder / "command.txt", shlex.join(sys.orig_argv) + "\n")
        _write_text(folder / "config.yml", plain_yaml.dump(config))
        _write_text(folder / "args.yml", plain_yaml.dump(args))
        about = {**library_versions(), "sb3_tdc": commit_of_the_code() or "a wheel", "processor": processor_name()}
        _write_text(folder / "versions.yml", plain_yaml.dump(about))


def _read_yaml(path: Path) -> dict[str, Any]:
    """
    Read a YAML file of the folder.

    :raises ValueError: if the file is not a mapping of plain values
    """
    content = plain_yaml.load(read_text(path, _MAX_YAML), str(path), is_trusted=False)
    if not isinstance(content, dict):
        raise ValueError(f"{path} must be a mapping")
    return content


def _write_text(path: Path, text: str) -> None:
    write_atomically(lambda part: part.write_text(text), path)


def folder_name(env_id: str) -> str:
    """Return an environment's id as it appears in the names of folders and files, without slashes and colons."""
    return env_id.replace("/", "-").replace(":", "-")


def _env_names(parent: Path) -> set[str]:
    return {config.parent.name for config in parent.glob("*/*/config.yml")}
