"""
What checkpoints cost: how long training waits for them, and what they write.

``python -m benchmarks.checkpoints`` trains TDC with the paper's hyperparameters (but for a shorter warm-up, so that it
is training that is measured), prints a table and writes it to ``docs/benchmarks/checkpoints.md``.
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
from sb3_tdc.checkpoint import DEFAULT_FREQ, Checkpoints
from sb3_tdc.hyperparams import hyperparams_file, parse, read_entry

ENVIRONMENTS = ("HalfCheetah-v4", "Humanoid-v4")
WARM_UP = 1_000


class Clock(BaseCallback):
    """When every checkpoint was written, and what was on disk then."""

    is_checkpointed = False

    def __init__(self, checkpoints: Checkpoints):
        super().__init__()
        self.checkpoints = checkpoints
        self.entries: list[tuple[int, float, float, int]] = []

    def _on_rollout_start(self) -> None:  # behind the checkpoints
        step = self.checkpoints.last_step
        if step is not None and (not self.entries or self.entries[-1][0] != step):
            size = disk_usage(self.checkpoints.store.folder)
            self.entries.append((step, time.perf_counter(), self.checkpoints.seconds, size))

    def _on_step(self) -> bool:
        return True


def disk_usage(folder: Path) -> int:
    """:return: bytes of all files below a folder, of linked ones once"""
    return sum({(s.st_ino): s.st_size for s in (p.stat() for p in folder.rglob("*") if p.is_file())}.values())


def measure(env_id: str, n_checkpoints: int, freq: int, folder: Path) -> dict[str, float]:
    """
    :return: seconds and megabytes by name
    """
    entry, _ = read_entry(hyperparams_file("tdc"), env_id)
    model = TDC(env=gym.make(env_id), seed=1, device="cpu", **{**_model_arguments(entry), "learning_starts": WARM_UP})
    checkpoints = Checkpoints(folder / "checkpoints", freq, verbose=0)
    clock = Clock(checkpoints)
    model.learn((n_checkpoints + 1) * freq + 10, callback=[checkpoints, clock])
    pauses = np.diff([seconds for _, _, seconds, _ in clock.entries])[1:]  # of the second one on: all of it training
    times = np.diff([moment for _, moment, _, _ in clock.entries])[1:]
    segments = [path.stat().st_size for path in sorted((folder / "checkpoints" / "replay").iterdir())]
    newest = max((folder / "checkpoints").glob("step_*"))
    buffer = model.replay_buffer
    sb3 = sum(array.nbytes for array in vars(buffer).values() if isinstance(array, np.ndarray))
    state = disk_usage(newest)
    checkpoints.store.close()
    return {
        "pause, median (s)": float(np.median(pauses)),
        "pause, longest (s)": float(np.max(pauses)),
        "between two checkpoints (s)": float(np.median(times)),
        "share of training time (%)": 100 * float(pauses.sum() / times.sum()),
        "written per checkpoint (MB)": (segments[-1] + state) / 1e6,
        "of it transitions (MB)": segments[-1] / 1e6,
        "on disk with a full buffer of 1,000,000 (MB)": (segments[-1] / freq * buffer.buffer_size + 2 * state) / 1e6,
        "SB3's save_replay_buffer, every time (MB)": sb3 / 1e6,
    }


def _model_arguments(entry: dict) -> dict:
    hyperparams = parse(entry, TDC, "tdc.yml")
    assert hyperparams.noise_type == "normal"
    return {**hyperparams.model, "action_noise": hyperparams.noise_std}


def report(results: dict[str, dict[str, float]], command: str) -> str:
    """:return: Markdown"""
    names = next(iter(results.values()))
    lines = ["# What checkpoints cost", "", f"`{command}`", ""]
    lines += [f"| | {' | '.join(results)} |", f"|---|{'---|' * len(results)}"]
    lines += [f"| {name} | {' | '.join(f'{result[name]:,.3g}' for result in results.values())} |" for name in names]
    versions = f"PyTorch {th.__version__}, Stable-Baselines3 {stable_baselines3.__version__}"
    lines += ["", f"{platform.machine()}, {th.get_num_threads()} thread(s), {versions}."]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="+", default=list(ENVIRONMENTS))
    parser.add_argument("--checkpoints", type=int, default=3, help="that are measured")
    parser.add_argument("--freq", type=int, default=DEFAULT_FREQ, help="steps between checkpoints")
    parser.add_argument("--num-threads", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="where to write them (default: a temporary folder)")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/benchmarks/checkpoints.md"))
    args = parser.parse_args()
    th.set_num_threads(args.num_threads)
    results = {}
    for env_id in args.envs:
        with tempfile.TemporaryDirectory(dir=args.folder) as folder:
            results[env_id] = measure(env_id, args.checkpoints, args.freq, Path(folder))
    text = report(results, f"python -m benchmarks.checkpoints --checkpoints {args.checkpoints} --freq {args.freq}")
    print(text)
    args.output.write_text(text)


if __name__ == "__main__":
    main()
