"""
Kill a training run (SIGKILL) at random instants, resume it each time, compare the end with a run that was left alone.

``python -m tests.checkpoint.kill --kills 50 --folder /tmp/kills`` prints where each kill struck and what differs; it
goes on where it was if it is itself stopped.
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
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_tdc import TDC
from tests.checkpoint.runs import digest, files

ROOT = Path(__file__).parents[2]
# train.py, that tells where it is when it is asked to (SIGUSR1), at once
_CODE = """
import faulthandler, signal, sys
faulthandler.register(signal.SIGUSR1, open(sys.argv.pop(1), "w"))
from sb3_tdc.train import main
sys.exit(main())
"""
# What a kill interrupts, by the innermost of these functions on the stack
_PHASES = {
    "_write": "writing a checkpoint",
    "_restore": "restoring",
    "evaluate_policy": "evaluating",
    "learn": "training",
    "make_experiment": "starting",
    "resume_experiment": "starting",
    "main": "starting",
}


def arguments(folder: Path, steps: int) -> list[str]:
    """:return: a run in which much happens: evaluations and checkpoints every second, a ring that is overwritten"""
    small = ["policy_kwargs:{net_arch: [32, 32], n_quantiles: 8}", "learning_starts:100", "batch_size:32"]
    run = ["--env", "Hopper-v4", "-n", str(steps), "--seed", "1", "-f", str(folder), "--save-freq", "1000"]
    often = ["--eval-freq", "120", "--eval-episodes", "3", "--checkpoint-freq", "60", "--log-interval", "1"]
    small += ["buffer_size:700", "n_envs:2", "normalize:true"]
    return [*run, *often, "--save-replay-buffer", "--device", "cpu", "--num-threads", "1", "-params", *small]


def start(args: list[str], stack: Path) -> subprocess.Popen:
    """:param stack: where the process writes its stack when it is asked to"""
    log = stack.with_suffix(".log").open("a")
    command = [sys.executable, "-W", "ignore", "-c", _CODE, str(stack), *args]
    return subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=subprocess.STDOUT, start_new_session=True)


def kill(process: subprocess.Popen, stack: Path) -> str:
    """:return: what it was doing, or that it had ended"""
    if stack.exists():
        process.send_signal(signal.SIGUSR1)
        deadline = time.monotonic() + 1
        while stack.stat().st_size == 0 and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.0005)
    ended = process.poll() is not None
    if not ended:
        os.killpg(process.pid, signal.SIGKILL)
    code = process.wait()
    if ended:
        assert code == 0, f"left with status {code}: see {stack.with_suffix('.log')}"
        return "ended"
    lines = stack.read_text().splitlines() if stack.exists() else []
    functions = [line.rpartition(" in ")[2] for line in lines]
    return next((_PHASES[function] for function in functions if function in _PHASES), "importing")


def outcome(folder: Path) -> dict[str, Any]:
    """:return: fingerprints of a finished run: weights, replay buffer, logs"""
    model = TDC.load(folder / "Hopper-v4.zip", device="cpu")
    model.load_replay_buffer(folder / "replay_buffer.pkl")
    found = {"weights": digest(model.policy.state_dict()), "updates": model._n_updates, "steps": model.num_timesteps}
    for network in ("actor", "critic"):
        found[f"{network}'s optimizer"] = digest(getattr(model, network).optimizer.state_dict())
    for name, value in vars(model.replay_buffer).items():
        if isinstance(value, (np.ndarray, int, bool)):
            found[f"replay_buffer.{name}"] = digest(value)
    for name in (Path("Hopper-v4") / "vecnormalize.pkl", Path("best_model_vecnormalize.pkl")):
        statistics = pickle.loads((folder / name).read_bytes())
        parts = [statistics.obs_rms.mean, statistics.obs_rms.var, statistics.obs_rms.count, statistics.ret_rms.var]
        found[str(name)] = digest(parts)
    saved = sorted(path.name for path in folder.glob("rl_model_*_steps.zip"))
    found["saved models"] = {name: digest(TDC.load(folder / name, device="cpu").policy.state_dict()) for name in saved}
    found["files"] = sorted(path.name for path in folder.iterdir() if "tfevents" not in path.name)
    return {**found, **files(folder)}


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--longest", type=float, default=2.0, help="seconds of training before a kill, at most")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    args.folder.mkdir(parents=True, exist_ok=True)

    alone, killed = (args.folder / name / "tdc" / "Hopper-v4_1" for name in ("alone", "killed"))
    if not (alone / "Hopper-v4" / "finished.yml").exists():
        assert not alone.exists(), f"{args.folder} holds a run that was not finished: take another folder"
        process = start(arguments(args.folder / "alone", args.steps), args.folder / "alone_stack")
        assert process.wait() == 0, "see alone_stack.log"

    record = args.folder / "kills.json"
    struck: list[str] = json.loads(record.read_text()) if record.exists() else []
    draw = random.Random(args.seed + len(struck))
    while len(struck) < args.kills:
        stack = args.folder / f"kill_{len(struck)}"
        stack.unlink(missing_ok=True)
        command = ["--resume", str(killed)]
        if not (killed / "Hopper-v4" / "args.yml").exists():  # it had not begun
            shutil.rmtree(args.folder / "killed", ignore_errors=True)
            command = arguments(args.folder / "killed", args.steps)
        process = start(command, stack)
        _wait(process, stack, until_it_trains=draw.random() < 0.9)
        time.sleep(draw.uniform(0, args.longest))
        where = kill(process, stack)
        if where == "ended":
            raise SystemExit(f"The run ended after {len(struck)} kills: more --steps")
        struck.append(where)
        record.write_text(json.dumps(struck))
        print(f"Kill {len(struck)}: {where}", flush=True)
    process = start(["--resume", str(killed)], args.folder / "last_stack")
    assert process.wait() == 0, "see last_stack.log"

    expected, found = outcome(alone), outcome(killed)
    differing = [name for name in expected | found if expected.get(name) != found.get(name)]
    print(f"{len(struck)} kills: {dict(collections.Counter(struck))}")
    print(f"{len(expected)} fingerprints compared; different: {differing or 'none'}")
    assert yaml.safe_load((killed / "Hopper-v4" / "args.yml").read_text())["seed"] == 1
    return int(bool(differing))


def _wait(process: subprocess.Popen, stack: Path, until_it_trains: bool) -> None:
    """Until it can tell where it is, which is before its imports, or until it says that it goes on."""
    log = stack.with_suffix(".log")
    while process.poll() is None and not stack.exists():
        time.sleep(0.005)
    while until_it_trains and process.poll() is None and not re.search("Going on from|eval ", log.read_text()):
        time.sleep(0.005)


if __name__ == "__main__":
    sys.exit(main())
