"""The speed of runs, from finished runs of the same algorithm and environment, or from a short training."""

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_tdc.experiments.jobs import Job
from sb3_tdc.experiments.results import find_runs
from sb3_tdc.runs.settings import RunSettings
from sb3_tdc.runs.setup import make_run
from sb3_tdc.runs.training import train

# The steps between which time is measured: the first updates compile, allocate and warm up
_FIRST_STEP, _LAST_STEP = 100, 300
_LEARNING_STARTS = _FIRST_STEP // 2
MEASURED_STEPS = _LAST_STEP - _FIRST_STEP


def read_rates(logs: Path) -> dict[tuple[str, str], float]:
    """
    Return the environment steps per second of finished runs, including evaluations.

    :return: the median by algorithm and environment; a resumed run counts with its time before the interruption
    """
    found: dict[tuple[str, str], list[float]] = {}
    try:
        runs, _ = find_runs(logs)
    except ValueError:
        return {}
    for finished in (one for one in runs if one.is_finished):
        progress = finished.progress("time/total_timesteps", "time/time_elapsed")
        if len(progress) and progress[-1, 1] > 0:
            found.setdefault((finished.algo, finished.env_id), []).append(progress[-1, 0] / progress[-1, 1])
    return {key: float(np.median(rates)) for key, rates in found.items()}


class _Clock(BaseCallback):
    """Record step and time, from ``_FIRST_STEP`` on."""

    def _on_training_start(self) -> None:
        self.readings: list[tuple[int, float]] = []

    def _on_step(self) -> bool:
        if self.num_timesteps >= _FIRST_STEP:
            self.readings.append((self.num_timesteps, time.perf_counter()))
        return True


def measure_rate(job: Job) -> float:
    """Measure environment steps per second over a few hundred steps on one thread, with updates but no evaluations."""
    clock = _Clock()
    n_timesteps = max(_LAST_STEP, 10 * job.config.get("n_envs", 1))
    config = replace(job, n_timesteps=n_timesteps).config
    # Also where the job sets it: updates must begin before the measured steps
    config["learning_starts"] = min(config.get("learning_starts", _LEARNING_STARTS), _LEARNING_STARTS)
    with tempfile.TemporaryDirectory() as folder:
        settings = RunSettings(
            algo=job.algo,
            env=job.env_id,
            n_timesteps=n_timesteps,
            seed=job.seed,
            log_folder=folder,
            hyperparams=config,
            gym_packages=list(job.packages),
            eval_freq=-1,
            resume_freq=-1,
            num_threads=1,
            device="cpu",
            verbose=0,
        )
        run = make_run(settings)
        run.hyperparams.callbacks.append(lambda: clock)
        if train(run).interrupted:
            raise KeyboardInterrupt
    (first, start), (last, end) = clock.readings[0], clock.readings[-1]
    return (last - first) / (end - start)
