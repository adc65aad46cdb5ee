"""Trials of a search on Ray Tune: each is one or several runs, and reports their early evaluations."""

import argparse
import time
import zipfile
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sb3_tdc.common.words import count
from sb3_tdc.experiments.jobs import Job, stop
from sb3_tdc.experiments.results import Run

_POLL_SECONDS = 1.0  # each poll reads the files of the runs, which takes time from training


_LONGEST_STEP_SECONDS = 5.0


def make_trainable(tune: Any, trials: Mapping[str, Sequence[Job]]) -> Any:
    """
    Make the class of a trial.

    :param tune: the module ``ray.tune``
    :param trials: by name, the jobs that run side by side: one seed, or all seeds of a candidate
    :return: the class of a trial
    """

    class Trial(tune.Trainable):
        def setup(self, config: dict[str, Any]) -> None:
            self.jobs = trials[config["trial"]]
            self.n_reported = 0
            self.processes = [job.start() for job in self.jobs if not job.is_finished]

        def step(self) -> dict[str, Any]:
            """Wait for the next evaluation of all seeds, but not long: Ray can stop a trial only between steps."""
            deadline = time.monotonic() + _LONGEST_STEP_SECONDS
            while True:
                has_ended = all(process.poll() is not None for process in self.processes)
                timesteps, returns = read_shared_evaluations(self.jobs)
                if has_ended or returns.shape[1] > self.n_reported or time.monotonic() > deadline:
                    break
                time.sleep(_POLL_SECONDS)
            failed = [job for job in self.jobs if has_ended and not job.is_finished]
            if failed:
                raise RuntimeError("; ".join(f"{job}: see {job.log}: {' | '.join(job.last_lines())}" for job in failed))
            self.n_reported = n = min(self.n_reported + 1, returns.shape[1])
            return {
                "steps": int(timesteps[n - 1]) if n else 0,
                "mean_return": float(returns[:, :n].mean()) if n else float("nan"),
                "last_return": float(returns[:, n - 1].mean()) if n else float("nan"),
                "done": has_ended and n == returns.shape[1],
            }

        def cleanup(self) -> None:
            stop(self.processes)

    return Trial


def read_shared_evaluations(jobs: Sequence[Job]) -> tuple[np.ndarray, np.ndarray]:
    """
    Read the evaluations that all seeds have.

    :return: timesteps, (evaluations,), and mean returns, (seeds, evaluations)
    """
    found = []
    for job in jobs:
        folder = job.run_folder
        try:
            evaluations = None if folder is None else Run.open(folder.path).evaluations
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):  # it is being written
            evaluations = None
        if evaluations is None:
            return np.empty(0, int), np.empty((len(jobs), 0))
        found.append(evaluations)
    shortest = min(len(each.timesteps) for each in found)
    return found[0].timesteps[:shortest], np.array([each.returns[:shortest].mean(axis=1) for each in found])


def run_trials(args: argparse.Namespace, trials: Mapping[str, Sequence[Job]]) -> tuple[bool, list[str]]:
    """
    Run trials on Ray Tune.

    :return: whether all trials ended, and the errors of those that failed
    """
    from ray import tune
    from ray.tune.schedulers import ASHAScheduler

    if not args.asha:  # ASHA compares all trials: finished ones report at once
        trials = {name: jobs for name, jobs in trials.items() if not all(job.is_finished for job in jobs)}
    if not trials:
        return True, []
    n_cpus = max(map(len, trials.values()))  # a CPU and a thread for each seed
    scheduler = ASHAScheduler(
        time_attr="steps",
        max_t=args.n_timesteps,
        grace_period=max(args.n_timesteps // 9, 1),
        reduction_factor=3,
        stop_last_trials=False,  # after its last evaluation, a run still has to write its model
    )
    # Also for a resumed search: the folders of the runs hold all that it needs, while Ray's state would be unpickled
    tuner = tune.Tuner(
        tune.with_resources(make_trainable(tune, trials), {"cpu": n_cpus}),
        param_space={"trial": tune.grid_search(list(trials))},
        tune_config=tune.TuneConfig(
            metric="mean_return", mode="max", scheduler=scheduler if args.asha else None, reuse_actors=False
        ),
        run_config=tune.RunConfig(
            name="ray",
            storage_path=str(args.folder),
            verbose=1,
            checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),  # the runs have their own resume states
        ),
    )
    results = tuner.fit()
    failed = [str(error).strip().splitlines()[-1] for error in results.errors]
    # Ray's own trial states do not tell: after a Ctrl-C, all are "terminated", even those of trials that never began
    ended = [result for result in results if result.error is not None or (result.metrics or {}).get("done")]
    return len(ended) == len(trials), failed


def make_trials(
    candidates: Sequence[Sequence[Job]], searched: Sequence[str], side_by_side: bool
) -> dict[str, Sequence[Job]]:
    """
    Group jobs into trials, by name.

    :param searched: names of hyperparameters; their values name the trials
    :param side_by_side: put all seeds of a candidate into one trial. A scheduler then stops whole candidates; stopping
        only their bad seeds would leave the mean of the lucky ones
    """

    def name(job: Job, seeds: str) -> str:
        return ", ".join([*(f"{key} {job.settings[key]}" for key in searched), seeds])

    if not side_by_side:
        return {name(job, f"seed {job.seed}"): [job] for jobs in candidates for job in jobs}
    return {name(jobs[0], count(len(jobs), "seed")): jobs for jobs in candidates}
