"""
Stop a training run at random instants, resume it each time, compare the end with a run that was left alone.

It is killed, or signalled together with the processes of its environments, also after the reader of its output has
gone; sometimes its folder is moved, and it is resumed from another working directory.
``python -m tests.tools.kill --kills 50 --folder /tmp/kills`` prints what each stop interrupted and what differs;
after an interruption, the same command continues.
"""

import argparse
import collections
import json
import os
import pickle
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_tdc import TDC
from tests.helpers.paths import ROOT
from tests.tools.runs import digest, files

# train.py, which writes its stack at once when it receives SIGUSR1
_CODE = """
import faulthandler, signal, sys
faulthandler.register(signal.SIGUSR1, open(sys.argv.pop(1), "w"))
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored below a job in the background of a shell
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # and this one below nohup
from sb3_tdc.cli.train import main
sys.exit(main())
"""
# What a kill interrupts, by the innermost of these functions on the stack
_PHASES = {
    "_write": "writing a state",
    "_restore": "restoring",
    "evaluate_policy": "evaluating",
    "learn": "training",
    "make_experiment": "starting",
    "resume_experiment": "starting",
    "main": "starting",
}


def arguments(folder: Path, steps: int) -> list[str]:
    """Return the arguments of an eventful run: evaluations and states every second, a ring buffer that wraps around."""
    small = ["policy_kwargs:{net_arch: [32, 32], n_quantiles: 8}", "learning_starts:100", "batch_size:32"]
    run = ["--env", "Hopper-v4", "-n", str(steps), "--seed", "1", "-f", str(folder), "--save-freq", "1000"]
    often = ["--eval-freq", "120", "--eval-episodes", "3", "--resume-freq", "60", "--log-interval", "1"]
    small += ["buffer_size:700", "n_envs:2", "normalize:true"]
    run += ["--vec-env", "subproc"]
    return [*run, *often, "--save-replay-buffer", "--device", "cpu", "--num-threads", "1", "-params", *small]


def start(args: list[str], stack: Path, directory: Path = ROOT) -> subprocess.Popen:
    """
    Start ``train.py``.

    :param stack: file to which the process writes its stack on SIGUSR1
    :return: the process; its output goes through a pipe to another process, which writes the log
    """
    log = stack.with_suffix(".log")
    command = [sys.executable, "-W", "ignore", "-c", _CODE, str(stack), *args]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    reader = subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=log.open("a"), start_new_session=True)
    with reader.stdin as pipe:
        process = subprocess.Popen(
            command, cwd=directory, env=environment, stdout=pipe, stderr=pipe, start_new_session=True
        )
    process.reader = reader
    return process


# How a run is stopped: signals in order, to its whole process group; None kills the reader of its output
WAYS: dict[str, list[signal.Signals | None]] = {
    "SIGKILL": [signal.SIGKILL],
    "SIGTERM": [signal.SIGTERM],
    "SIGTERM twice": [signal.SIGTERM, signal.SIGTERM],
    "SIGHUP": [signal.SIGHUP],
    "SIGINT": [signal.SIGINT],
    "closed pipe and SIGTERM": [None, signal.SIGTERM],
}
# It stopped after a signal, or the signal came before it could be handled
_STATUSES = {130, -signal.SIGKILL, -signal.SIGTERM, -signal.SIGHUP, -signal.SIGINT}


def stop(process: subprocess.Popen, stack: Path, way: str) -> str:
    """Stop a run, and return what it was doing, or that it had ended."""
    if stack.exists():
        process.send_signal(signal.SIGUSR1)
        deadline = time.monotonic() + 1
        while stack.stat().st_size == 0 and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.0005)
    for number in WAYS[way]:
        if number is None:
            process.reader.kill()
            time.sleep(0.3)
        elif process.poll() is None:
            os.killpg(process.pid, number)
    code = process.wait()
    if code == 0:
        return "ended"
    assert code in _STATUSES, f"left with status {code}: see {stack.with_suffix('.log')}"
    lines = stack.read_text().splitlines() if stack.exists() else []
    functions = [line.rpartition(" in ")[2] for line in lines]
    return next((_PHASES[function] for function in functions if function in _PHASES), "importing")


def outcome(folder: Path) -> dict[str, Any]:
    """Return fingerprints of a finished run: weights, replay buffer, logs."""
    model = TDC.load(folder / "Hopper-v4.zip", device="cpu")
    model.load_replay_buffer(folder / "replay_buffer.pkl")
    found = {"weights": digest(model.policy.state_dict()), "updates": model._n_updates, "steps": model.num_timesteps}
    for network in ("actor", "critic"):
        found[f"{network}'s optimizer"] = digest(getattr(model, network).optimizer.state_dict())
    for name, value in vars(model.replay_buffer).items():
        if isinstance(value, (np.ndarray, int, bool)):
            found[f"replay_buffer.{name}"] = digest(value)
    for file in (Path("Hopper-v4") / "vecnormalize.pkl", Path("best_model_vecnormalize.pkl")):
        statistics = pickle.loads((folder / file).read_bytes())
        parts = [statistics.obs_rms.mean, statistics.obs_rms.var, statistics.obs_rms.count, statistics.ret_rms.var]
        found[str(file)] = digest(parts)
    saved = sorted(path.name for path in folder.glob("rl_model_*_steps.zip"))
    found["saved models"] = {name: digest(TDC.load(folder / name, device="cpu").policy.state_dict()) for name in saved}
    found["files"] = sorted(path.name for path in folder.iterdir() if "tfevents" not in path.name)
    return {**found, **files(folder)}


@dataclass
class Series:
    """
    A run that is stopped again and again.

    :param folder: folder of the series; the run lies in ``<folder>/<place>/tdc/Hopper-v4_1``
    :param struck: for each stop, how the run was stopped and what was interrupted
    """

    folder: Path
    place: str = "stopped"
    struck: list[str] = field(default_factory=list)

    @property
    def run(self) -> Path:
        return self.folder / self.place / "tdc" / "Hopper-v4_1"

    @property
    def _record(self) -> Path:
        return self.folder / "stops.json"

    def load(self) -> None:
        if self._record.exists():
            self.place, self.struck = json.loads(self._record.read_text())

    def stop_once(self, draw: random.Random, args: argparse.Namespace) -> None:
        """Start or resume the run, and stop it; perhaps move it."""
        directory = self.folder / f"directory_{len(self.struck)}" if draw.random() < 0.5 else ROOT
        directory.mkdir(exist_ok=True)
        command = ["--resume", os.path.relpath(self.run, directory)]
        if not (self.run / "Hopper-v4" / "args.yml").exists():  # it had not begun
            shutil.rmtree(self.folder / self.place, ignore_errors=True)
            command = arguments(self.folder / self.place, args.steps)
        stack = self.folder / f"stop_{len(self.struck)}"
        stack.unlink(missing_ok=True)
        process, way = start(command, stack, directory), draw.choice(list(WAYS))
        _wait(process, stack, until_it_trains=draw.random() < 0.9)
        time.sleep(draw.uniform(0, args.longest))
        phase = stop(process, stack, way)
        if phase == "ended":
            raise SystemExit(f"The run ended after {len(self.struck)} stops: more --steps")
        if directory != ROOT:
            assert not list(directory.iterdir()), f"it wrote into {directory}"
        moved = ""
        if draw.random() < 0.3 and self.run.exists():
            place, moved = f"moved_{len(self.struck)}", ", then moved"
            os.replace(self.folder / self.place, self.folder / place)
            self.place = place
        self.struck.append(f"{way} while {phase}{moved}")
        self._record.write_text(json.dumps([self.place, self.struck]))
        print(f"Stop {len(self.struck)}: {self.struck[-1]}", flush=True)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--longest", type=float, default=2.0, help="seconds of training before a stop, at most")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    args.folder = args.folder.resolve()
    args.folder.mkdir(parents=True, exist_ok=True)

    alone, series = args.folder / "alone" / "tdc" / "Hopper-v4_1", Series(args.folder)
    series.load()
    if not (alone / "Hopper-v4" / "finished.yml").exists():
        assert not alone.exists(), f"{args.folder} holds a run that was not finished: take another folder"
        process = start(arguments(args.folder / "alone", args.steps), args.folder / "alone_stack")
        assert process.wait() == 0, "see alone_stack.log"
    draw = random.Random(args.seed + len(series.struck))
    while len(series.struck) < args.kills:
        series.stop_once(draw, args)
    process = start(["--resume", str(series.run)], args.folder / "last_stack")
    assert process.wait() == 0, "see last_stack.log"

    expected, found = outcome(alone), outcome(series.run)
    differing = [name for name in expected | found if expected.get(name) != found.get(name)]
    for what, count in sorted(collections.Counter(text.partition(",")[0] for text in series.struck).items()):
        print(f"{count:4} × {what}")
    print(f"{sum('moved' in text for text in series.struck)} of {len(series.struck)} times its folder was moved")
    print(f"{len(expected)} fingerprints compared; different: {differing or 'none'}")
    assert yaml.safe_load((series.run / "Hopper-v4" / "args.yml").read_text())["seed"] == 1
    return int(bool(differing))


def _wait(process: subprocess.Popen, stack: Path, until_it_trains: bool) -> None:
    """Wait until the process can report its stack, which is before its imports, or until it has begun to train."""
    log = stack.with_suffix(".log")
    while process.poll() is None and not stack.exists():
        time.sleep(0.005)
    while until_it_trains and process.poll() is None and not re.search("Continuing from|eval ", log.read_text()):
        time.sleep(0.005)


if __name__ == "__main__":
    sys.exit(main())
