"""
One run of ``sb3-tdc train`` in its own folder and process, as the matrix and the search start it.
"""

import importlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sb3_tdc.common import plain_yaml
from sb3_tdc.common.files import lock
from sb3_tdc.experiments.results import Run, check_same_run, shorten_warm_up
from sb3_tdc.hyperparams import hyperparams_file, merge, read_entry
from sb3_tdc.resume import DEFAULT_FREQ
from sb3_tdc.resume.store import stored_steps
from sb3_tdc.runs.folder import RunFolder, folder_name
from sb3_tdc.runs.settings import Role, defaults

_POLL_SECONDS = 0.2
_SECONDS_TO_ANSWER = 5.0
_EVAL_FREQ: int = defaults(Role.EXPERIMENT)["eval_freq"]


class TrainedElsewhereError(ValueError):
    """Another process trains this run."""


@dataclass(frozen=True)
class Job:
    """
    One run to train.

    :param settings: hyperparameters that override those of ``hyperparams/``
    :param logs: the log folder of this run; it may hold runs of other algorithms and environments
    :param packages: packages to import, which register the environment
    """

    algo: str
    env_id: str
    seed: int
    n_timesteps: int
    logs: Path
    settings: dict[str, Any] = field(default_factory=dict)
    packages: tuple[str, ...] = ()

    @property
    def config(self) -> dict[str, Any]:
        """All hyperparameters; unless set, the warm-up is that of ``hyperparams/``, but at most a tenth of the run."""
        entry, _ = read_entry(hyperparams_file(self.algo), self.env_id)
        config = {**merge(entry, self.settings), "n_timesteps": self.n_timesteps}
        if "learning_starts" in entry and "learning_starts" not in self.settings:
            config["learning_starts"] = shorten_warm_up(entry["learning_starts"], self.n_timesteps)
        return config

    @property
    def arguments(self) -> list[str]:
        """The arguments of ``sb3-tdc train``."""
        entry, _ = read_entry(hyperparams_file(self.algo), self.env_id)
        params = {k: v for k, v in self.config.items() if k != "n_timesteps" and (k not in entry or entry[k] != v)}
        resume_freq = min(DEFAULT_FREQ, max(self.n_timesteps // 10, 1))
        return [
            *("--algo", self.algo, "--env", self.env_id, "-n", str(self.n_timesteps), "--seed", str(self.seed)),
            *("-f", str(self.logs), "--eval-freq", str(eval_freq(self.n_timesteps))),
            *("--resume-freq", str(resume_freq), "--num-threads", "1", "--device", "cpu", "--no-progress"),
            *(["--gym-packages", *self.packages] if self.packages else []),
            *(["-params", *(f"{key}:{_to_yaml(value)}" for key, value in params.items())] if params else []),
        ]

    @property
    def log(self) -> Path:
        """The file that the run writes its output to."""
        return self.logs / self.algo / f"{self._env_name}.log"

    @property
    def run_folder(self) -> RunFolder | None:
        """
        The folder of the run; None if the run has not begun.

        :raises ValueError: if another run is in its place
        """
        begun = (self.logs / self.algo).glob(f"{self._env_name}_*/{self._env_name}/args.yml")
        newest = max(begun, key=lambda path: path.stat().st_mtime, default=None)
        if newest is None:
            return None
        folder = RunFolder.open(newest.parents[1])
        here = {**folder.config, "seed": folder.args.get("seed"), "eval_freq": folder.args.get("eval_freq")}
        wanted = {**self.config, "seed": self.seed, "eval_freq": eval_freq(self.n_timesteps)}
        check_same_run(folder.path, here, wanted)
        return folder

    @property
    def steps_done(self) -> int:
        """The step from which the run would be resumed; all steps if it is finished."""
        folder = self.run_folder
        if folder is None:
            return 0
        if folder.is_finished:
            return self.n_timesteps
        return max(stored_steps(folder.resume_folder), default=0)

    @property
    def is_finished(self) -> bool:
        folder = self.run_folder
        return folder is not None and folder.is_finished

    @property
    def is_trained_elsewhere(self) -> bool:
        """Return whether another process trains the run now."""
        if not self.log.is_file():
            return False
        log = lock(self.log)
        if log is None:
            return True
        log.close()
        return False

    @property
    def _env_name(self) -> str:
        return folder_name(self.env_id)

    def __str__(self) -> str:
        settings = "".join(f" {key}={_to_yaml(value)}" for key, value in self.settings.items())
        return f"{self.algo} {self.env_id}{settings} seed {self.seed}"

    def start(self) -> subprocess.Popen:
        """
        Start the run, or resume it.

        :return: the process; it stops with a resume state on SIGTERM, and at once if this process dies
        :raises TrainedElsewhereError: if another process trains this run
        """
        self.log.parent.mkdir(parents=True, exist_ok=True)
        log = lock(self.log)  # inherited by the process: locked as long as the run or a child of it lives
        if log is None:
            raise TrainedElsewhereError(f"{self}: another process trains it")
        with log:
            folder = self.run_folder
            arguments = self.arguments if folder is None else ["--resume", str(folder.path)]
            return subprocess.Popen(
                [sys.executable, "-m", "sb3_tdc", "job", *arguments],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
                start_new_session=True,  # a Ctrl-C in the terminal must not reach it
            )

    def last_lines(self, n: int = 3) -> list[str]:
        """Return the last lines of the log."""
        if not self.log.is_file():
            return []
        with self.log.open(errors="replace") as lines:
            return [line.rstrip() for line in deque((line for line in lines if line.strip()), n)]

    @property
    def final_return(self) -> float | None:
        """The mean of the last evaluation."""
        folder = self.run_folder
        evaluations = None if folder is None else Run.open(folder.path).evaluations
        return None if evaluations is None else float(evaluations.returns[-1].mean())


def eval_freq(n_timesteps: int) -> int:
    """Return the steps between evaluations: the paper's 20,000, but at most a thirtieth of the run."""
    return min(_EVAL_FREQ, max(n_timesteps // 30, 1))


def stop(processes: Sequence[subprocess.Popen]) -> None:
    """Stop processes: wait until they have written their resume states and ended, then close their pipes."""
    for process in processes:
        if process.poll() is None:
            process.terminate()
    for process in processes:
        process.wait()
        if process.stdin is not None:
            process.stdin.close()


def run(job: Job) -> int | None:
    """
    Run a job to its end; on an interrupt, it stops with a resume state.

    :return: the exit status of ``sb3-tdc train``; None if another process trains the run
    """
    try:
        process = job.start()
    except TrainedElsewhereError:
        return None
    try:
        while process.poll() is None:
            time.sleep(_POLL_SECONDS)
    finally:
        stop([process])
    return process.returncode


def import_ray() -> Any:
    """
    Import Ray.

    :raises ValueError: if Ray is not installed, with the command that installs it
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        return importlib.import_module("ray")
    except ImportError as error:
        raise ValueError('Runs are distributed by Ray: pip install "sb3-tdc[tune]"') from error


def check_address(address: str) -> None:
    """
    Check that the address of a cluster answers: Ray itself would try for minutes.

    :raises ValueError: if it is not an address, or nothing answers
    """
    if address in ("auto", "local"):  # Ray looks on this machine
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise ValueError(f"--address must be HOST:PORT, or auto for the cluster of this machine, got {address!r}")
    try:
        socket.create_connection((host.strip("[]"), int(port)), _SECONDS_TO_ANSWER).close()
    except OSError as error:
        raise ValueError(f"--address {address}: nothing answers there ({error.strerror or error})") from error


@contextmanager
def cluster(address: str | None, n_jobs: int | None) -> Iterator[Any]:
    """
    Start Ray, or connect to a cluster, for the duration of the context.

    :param address: address of a cluster that shares this file system; None for this machine
    :param n_jobs: number of jobs at once on this machine; None for one per core
    :return: the Ray module
    :raises ValueError: if Ray is not installed, or the cluster cannot be reached
    """
    if address is not None:
        check_address(address)
    os.environ.setdefault("RAY_worker_niceness", "0")  # workers, and so the runs, keep the niceness of this process
    ray = import_ray()
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    if address is None:
        options |= {"num_cpus": n_jobs or count_cores(), "include_dashboard": False}
    try:
        ray.init(address=address or "local", **options)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise ValueError(f"Ray did not start: {' '.join(str(error).split())}") from error
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # like Ctrl-C, even where that is ignored (nohup)
    try:
        yield ray
    finally:
        ray.shutdown()


def count_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _to_yaml(value: Any) -> str:
    text = plain_yaml.dump(value, default_flow_style=True, width=sys.maxsize)
    return text.removesuffix("\n").removesuffix("\n...")
