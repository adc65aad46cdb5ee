"""
The cost of resume states: how long training waits for them, and how much they write.

``python -m benchmarks.resume`` trains TDC with the paper's hyperparameters for a few thousand steps, to measure the
time of a step. It then continues without updates, which do not change the pauses, until enough states have been
written. It prints a table and writes it to ``docs/benchmarks/resume.md``.
"""

import argparse
import platform
import tempfile
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import stable_baselines3
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_tdc import TDC
from sb3_tdc.hyperparams import hyperparams_file, parse, read_entry
from sb3_tdc.resume import DEFAULT_FREQ, ResumeCallback

ENVIRONMENTS = ("HalfCheetah-v4", "Humanoid-v4")
WARM_UP, TIMED = 300, 2_000


class Clock(BaseCallback):
    """A callback that measures the seconds of a training step, and those that training waits for each state."""

    is_captured = False

    def __init__(self, states: ResumeCallback):
        super().__init__()
        self.states = states
        self.per_step = 0.0
        self.pauses: list[float] = []
        self.step, self.seconds = 0, 0.0

    def _on_rollout_start(self) -> None:  # called after the state is written
        if self.num_timesteps == 2 * WARM_UP:
            self.start = time.perf_counter()
        elif self.num_timesteps == 2 * WARM_UP + TIMED:
            self.per_step = (time.perf_counter() - self.start) / TIMED
            self.model.gradient_steps = 0
        if self.states.last_step not in (None, 0, self.step):
            self.pauses.append(self.states.seconds - self.seconds)
        self.step, self.seconds = self.states.last_step or 0, self.states.seconds

    def _on_step(self) -> bool:
        return True


def disk_usage(folder: Path) -> int:
    """Return the bytes of all files below a folder; files with several hard links count once."""
    return sum({(s.st_ino): s.st_size for s in (p.stat() for p in folder.rglob("*") if p.is_file())}.values())


def measure(env_id: str, n_states: int, freq: int, folder: Path) -> dict[str, float]:
    """Return the measured seconds, megabytes and shares by name."""
    entry, _ = read_entry(hyperparams_file("tdc"), env_id)
    model = TDC(env=gym.make(env_id), seed=1, device="cpu", **{**_model_arguments(entry), "learning_starts": WARM_UP})
    states = ResumeCallback(folder / "resume", freq, verbose=0)
    clock = Clock(states)
    model.learn(n_states * freq + 10, callback=[states, clock])
    segments = [path.stat().st_size for path in sorted((folder / "resume" / "replay").iterdir())]
    newest = max((folder / "resume").glob("step_*"))
    buffer = model.replay_buffer
    sb3 = sum(array.nbytes for array in vars(buffer).values() if isinstance(array, np.ndarray))
    state = disk_usage(newest)
    states.store.close()
    return {
        "training step (ms)": 1e3 * clock.per_step,
        "pause, median (s)": float(np.median(clock.pauses)),
        "pause, longest (s)": max(clock.pauses),
        "share of training time (%)": 100 * float(np.median(clock.pauses)) / (freq * clock.per_step),
        "written per state (MB)": (segments[-1] + state) / 1e6,
        "of it transitions (MB)": segments[-1] / 1e6,
        "on disk with a full buffer of 1,000,000 (MB)": (segments[-1] / freq * buffer.buffer_size + 2 * state) / 1e6,
        "SB3's save_replay_buffer, every time (MB)": sb3 / 1e6,
    }


def _model_arguments(entry: dict) -> dict:
    hyperparams = parse(entry, TDC, "tdc.yml")
    assert hyperparams.noise_type == "normal"
    return {**hyperparams.model, "action_noise": hyperparams.noise_std}


def report(results: dict[str, dict[str, float]], command: str) -> str:
    """Return the report in Markdown."""
    names = next(iter(results.values()))
    lines = ["# What states cost", "", f"`{command}`", ""]
    lines += [f"| | {' | '.join(results)} |", f"|---|{'---|' * len(results)}"]
    lines += [f"| {name} | {' | '.join(f'{result[name]:,.3g}' for result in results.values())} |" for name in names]
    versions = f"PyTorch {th.__version__}, Stable-Baselines3 {stable_baselines3.__version__}"
    lines += ["", f"{platform.machine()}, {th.get_num_threads()} thread(s), {versions}."]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="+", default=list(ENVIRONMENTS))
    parser.add_argument("--states", type=int, default=4, help="that are measured")
    parser.add_argument("--freq", type=int, default=DEFAULT_FREQ, help="steps between states")
    parser.add_argument("--num-threads", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="where to write them (default: a temporary folder)")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/benchmarks/resume.md"))
    args = parser.parse_args()
    th.set_num_threads(args.num_threads)
    results = {}
    for env_id in args.envs:
        with tempfile.TemporaryDirectory(dir=args.folder) as folder:
            results[env_id] = measure(env_id, args.states, args.freq, Path(folder))
    text = report(results, f"python -m benchmarks.resume --states {args.states} --freq {args.freq}")
    print(text)
    args.output.write_text(text)


if __name__ == "__main__":
    main()
