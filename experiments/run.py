"""``python -m experiments.run SUITE``: the runs of a figure of the paper, several at once; the same command goes on."""

import argparse
import heapq
import importlib
import shlex
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from experiments.jobs import Job, cluster, count_cores, run
from experiments.publish import RESULTS
from experiments.results import default_settings, find_runs, same_settings
from experiments.suites import ISAAC, PACKAGES, PAPER, SUITES, Cell
from sb3_tdc import train
from sb3_tdc.arguments import Names, Parser, one_of
from sb3_tdc.experiment import ALGORITHMS
from sb3_tdc.experiment import train as train_experiment
from sb3_tdc.hyperparams import hyperparams_file, read_entry, suggest

# Of a measurement of speed: the first updates compile, allocate, warm up
_FIRST, _LAST = 100, 300
_SECONDS_TO_STOP = 60.0


@dataclass(frozen=True)
class Plan:
    """
    :param jobs: what a suite asks for, each once
    :param missing: a sentence for each cell that cannot be run here
    """

    jobs: list[Job]
    missing: list[str]


def select(cells: Iterable[Cell], only: Sequence[str]) -> list[Cell]:
    """
    :param only: algorithms and environments; where none of a kind is named, all of it
    :raises ValueError: for one that no cell has
    """
    cells = list(cells)
    algos, env_ids = {cell.algo for cell in cells}, {cell.env_id for cell in cells}
    for name in only:
        if name not in algos | env_ids:
            known = [*sorted(algos), *sorted(env_ids)]
            raise ValueError(f"--only {name} is not in the suite{suggest(name, known)}; it has {', '.join(known)}")
    algos, env_ids = algos & set(only) or algos, env_ids & set(only) or env_ids
    return [cell for cell in cells if cell.algo in algos and cell.env_id in env_ids]


def make_plan(cells: Sequence[Cell], seeds: Sequence[int], scale: float, logs: Path) -> Plan:
    """
    Seed by seed, so that a matrix that is stopped early has something of every cell.

    :param scale: the fraction of the suite's steps
    :param logs: of all runs; those of a scale, or of a number of steps, have a folder of their own
    """
    missing = {f"{cell.algo} on {cell.env_id}": _why_missing(cell) for cell in cells}
    possible = [cell for cell in cells if not missing[f"{cell.algo} on {cell.env_id}"]]
    found = {}
    for seed in seeds:
        for job in (make_job(cell, seed, scale, logs) for cell in possible):
            found[job.logs, job.algo, job.env_id] = job
    return Plan(list(found.values()), [f"{what}: {why}" for what, why in missing.items() if why])


def make_job(cell: Cell, seed: int, scale: float, logs: Path) -> Job:
    """What a cell says that ``hyperparams/`` or a default says too is left out: cells of two suites may be one job."""
    entry, _ = read_entry(hyperparams_file(cell.algo), cell.env_id)
    implied = {**default_settings(cell.algo), **entry}
    settings = {key: value for key, value in cell.settings.items() if not same_settings(implied.get(key), value)}
    variant = ",".join(f"{key}={value}" for key, value in settings.items())
    n_timesteps = max(round(scale * (cell.n_timesteps or entry["n_timesteps"])), 1)
    length = f"steps_{n_timesteps}" if cell.n_timesteps else f"scale_{scale:g}"
    return Job(
        cell.algo,
        cell.env_id,
        seed,
        n_timesteps=n_timesteps,
        logs=logs.resolve() / length / variant / f"seed_{seed}",
        settings=settings,
        packages=(PACKAGES[cell.env_id],) if cell.env_id in PACKAGES else (),
    )


def _why_missing(cell: Cell) -> str:
    """:return: "" if it can be run"""
    if cell.algo not in ALGORITHMS:
        return f"this version of the package has no {cell.algo.upper()}"
    if cell.env_id in ISAAC:
        return "Isaac Lab starts its own simulator, with environments of tensors, which train.py does not take"
    if package := PACKAGES.get(cell.env_id):
        try:
            importlib.import_module(package)
        except ImportError:
            return f"pip install {package}"
    return "" if cell.env_id in gym.registry else "there is no such environment"


# ---------------------------------------------------------------- how long


def estimate_seconds(seconds: Iterable[float], n_jobs: int) -> float:
    """:return: until the last of the jobs has ended, if each is taken by the first of ``n_jobs`` that is free"""
    free_at = [0.0] * n_jobs
    for duration in seconds:
        heapq.heappush(free_at, heapq.heappop(free_at) + duration)
    return max(free_at)


def read_rates(logs: Path) -> dict[tuple[str, str], float]:
    """
    Environment steps per second, evaluations included, of finished runs.

    :return: by algorithm and environment, the median; time that a run stood still before it was resumed counts
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
    """Reads the time at two steps."""

    times: dict[int, float]

    def _on_training_start(self) -> None:
        self.times = {}

    def _on_step(self) -> bool:
        if self.num_timesteps in (_FIRST, _LAST):
            self.times[self.num_timesteps] = time.perf_counter()
        return True


def measure_rate(job: Job) -> float:
    """:return: environment steps per second, with updates, without evaluations; on one thread, over a few hundred"""
    clock = _Clock()
    with tempfile.TemporaryDirectory() as folder:
        measured = Job(job.algo, job.env_id, job.seed, _LAST, Path(folder), job.settings, job.packages)
        arguments = [*measured.arguments, "--eval-freq", "-1", "--checkpoint-freq", "-1", "--verbose", "0"]
        experiment = train.make_experiment(train.make_parser().parse_args(arguments))
        experiment.hyperparams.callbacks.append(lambda: clock)
        if train_experiment(experiment).interrupted:
            raise KeyboardInterrupt
    return (_LAST - _FIRST) / (clock.times[_LAST] - clock.times[_FIRST])


def dry_run(plan: Plan, rates: Mapping[tuple[str, str], float], n_jobs: int) -> None:
    """Print what would be done with every job, and how long it would take."""
    rates, seconds = dict(rates), []
    for job in plan.jobs:
        key, done = (job.algo, job.env_id), job.steps_done
        verb = "skip" if job.is_finished else "run" if job.run_folder is None else "resume"
        print(f"{verb:6} {job}, {job.n_timesteps:,} steps" + (f", {done:,} done" if verb == "resume" else ""))
        if verb != "skip":
            if key not in rates:
                rates[key] = measure_rate(job)
                print(f"       {rates[key]:.0f} steps/s, of {_LAST - _FIRST} steps, without evaluations")
            seconds.append((job.n_timesteps - done) / rates[key])
    total = timedelta(seconds=round(estimate_seconds(seconds, n_jobs)))
    print(f"{len(seconds)} of {len(plan.jobs)} to run, {n_jobs} at once: about {total} (hours:minutes:seconds)")


# ---------------------------------------------------------------- running


@dataclass
class Outcome:
    """
    :param failed: a sentence for each job that failed
    :param stopped: whether the user stopped the matrix
    """

    failed: list[str]
    stopped: bool = False


def run_jobs(ray: Any, jobs: Sequence[Job], n_jobs: int | None) -> Outcome:
    """
    :param ray: the module, initialised
    :param n_jobs: how many at once; None for as many as Ray has CPUs
    """
    # One CPU each, and one thread (in a job's arguments); a job whose machine is lost is started again, and resumes
    execute = ray.remote(num_cpus=1, max_retries=2)(run)
    waiting, outcome = list(reversed(jobs)), Outcome([])
    running: dict[Any, tuple[Job, float]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < (n_jobs or int(ray.cluster_resources().get("CPU", 1))):
                job = waiting.pop()
                print(f"{'resume' if job.run_folder else 'run':6} {job}", flush=True)
                running[execute.remote(job)] = job, time.monotonic()
            ended, _ = ray.wait(list(running), timeout=1.0)
            for reference in ended:
                job, start = running.pop(reference)
                why = _why_failed(ray, reference, job)
                outcome.failed += [f"{job}: {why}"] if why else []
                took = timedelta(seconds=round(time.monotonic() - start))
                result = "FAILED" if why else f"return {job.final_return:.1f}" if job.final_return is not None else ""
                progress = f"[{len(jobs) - len(waiting) - len(running)}/{len(jobs)}]"
                print(f"end    {job}, {took}, {result} {progress}", flush=True)
    except KeyboardInterrupt:
        outcome.stopped = True
        print("\nStopping: the runs write their checkpoints.", file=sys.stderr, flush=True)
        for reference in running:
            ray.cancel(reference)
        if running:
            ray.wait(list(running), num_returns=len(running), timeout=_SECONDS_TO_STOP)
    return outcome


def _why_failed(ray: Any, reference: Any, job: Job) -> str:
    """:return: "" if the job is finished"""
    try:
        status = ray.get(reference)
    except ray.exceptions.RayError as error:
        return " ".join(str(error).split())
    if status == 0 and job.is_finished:
        return ""
    return "\n  ".join([f"exit status {status}, see {job.log}", *job.last_lines()])


def make_parser() -> Parser:
    """:return: of the command line"""
    parser = Parser("Train the runs of one of the paper's figures; finished ones are skipped, stopped ones go on.")
    add = parser.add_argument
    add("suite", type=one_of("suite", [*SUITES, "all"]), help=f"{', '.join(SUITES)}, or all of the paper's")
    add("--seeds", type=int, nargs="+", default=[5], help="how many (one number), or which (several)")
    add("--scale", type=float, default=1.0, help="fraction of the suite's steps")
    add("--only", nargs="+", action=Names, default=[], metavar="NAME", help="algorithms and environments")
    add("--logs", type=Path, default=Path("logs"), help="folder of all runs")
    add("--results", type=Path, default=RESULTS, help="folder of published results: runs that are there are skipped")
    add("--jobs", type=int, help="runs at once (default: one a core)")
    add("--address", help="of a Ray cluster that shares this file system (default: this machine)")
    add("--dry-run", action="store_true", help="say what would be run, and how long it would take")
    return parser


def _plan(args: argparse.Namespace) -> Plan:
    """:raises ValueError: for anything that is not allowed"""
    if not 0 < args.scale <= 1:
        raise ValueError(f"--scale must be above 0 and at most 1, got {args.scale:g}")
    if args.jobs is not None and args.jobs < 1:
        raise ValueError(f"--jobs must be at least 1, got {args.jobs}")
    if min(args.seeds) < (1 if len(args.seeds) == 1 else 0):
        raise ValueError(f"--seeds must be how many (at least 1), or which (0 or more), got {min(args.seeds)}")
    seeds = range(1, args.seeds[0] + 1) if len(args.seeds) == 1 else list(dict.fromkeys(args.seeds))
    cells = [cell for suite in (PAPER if args.suite == "all" else [args.suite]) for cell in SUITES[suite]]
    return make_plan(select(cells, args.only), seeds, args.scale, args.logs)


def _without_published(plan: Plan, args: argparse.Namespace) -> Plan:
    """:return: the jobs that have no published results"""

    def is_published(job: Job) -> bool:
        return replace(job, logs=args.results / job.logs.relative_to(args.logs.resolve())).is_finished

    jobs = [job for job in plan.jobs if not is_published(job)]
    if len(jobs) < len(plan.jobs):
        print(f"{len(plan.jobs) - len(jobs)} of {len(plan.jobs)} runs are in {args.results}")
    return replace(plan, jobs=jobs)


def _describe(args: argparse.Namespace, plan: Plan) -> None:
    for sentence in plan.missing:
        print(f"missing {sentence}")
    if plan.jobs and args.scale < 1:
        print(
            f"At {args.scale:g} of the paper's steps, so are the evaluations (every thirtieth of a run, at most 20,000 "
            "steps); random steps at the start: as in the paper, but at most a tenth of a run."
        )


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: arguments, those of the process by default
    :return: 0 if all that can be run is finished, 1 if something failed, 130 if the user stopped it
    """
    parser = make_parser()
    args = parser.parse_args(argv)
    try:
        plan = _plan(args)
        plan = _without_published(plan, args)
        to_run = [job for job in plan.jobs if not job.is_finished]
        _describe(args, plan)
        if args.dry_run:
            dry_run(plan, read_rates(args.logs), args.jobs or count_cores())
            return 0
        print(f"{len(plan.jobs) - len(to_run)} of {len(plan.jobs)} runs are finished already", flush=True)
        if not to_run:
            return 0
        with cluster(args.address, args.jobs) as ray:
            outcome = run_jobs(ray, to_run, args.jobs)
    except ValueError as error:
        parser.fail(error)
    except KeyboardInterrupt:
        return 130
    for sentence in outcome.failed:
        print(f"failed {sentence}", file=sys.stderr)
    if outcome.stopped:
        print("To go on: the same command", file=sys.stderr)
        return 130
    for folder in dict.fromkeys(args.logs / job.logs.relative_to(args.logs.resolve()).parts[0] for job in plan.jobs):
        print(f"To look at them: python -m experiments.report {shlex.quote(str(folder))}")
    return int(bool(outcome.failed))


if __name__ == "__main__":
    sys.exit(main())
