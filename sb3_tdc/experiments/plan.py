"""The plan of a suite: which runs to train, and how long they take."""

import heapq
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

from sb3_tdc.common.checks import suggest
from sb3_tdc.envs.registry import require_env, simulator_of
from sb3_tdc.experiments.jobs import Job
from sb3_tdc.experiments.rates import MEASURED_STEPS, measure_rate
from sb3_tdc.experiments.results import default_settings, same_settings, shorten_warm_up
from sb3_tdc.experiments.suites import Cell
from sb3_tdc.hyperparams import hyperparams_file, read_entry
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS


@dataclass(frozen=True)
class Plan:
    """
    The jobs of a suite.

    :param jobs: the jobs that the suite requires, without duplicates
    :param missing: one sentence for each cell that cannot be run here
    """

    jobs: list[Job]
    missing: list[str]


def select(cells: Iterable[Cell], only: Sequence[str]) -> list[Cell]:
    """
    Select cells of a suite.

    :param only: names of algorithms and environments; if no algorithm is named, all algorithms are selected, and if no
        environment is named, all environments
    :raises ValueError: for a name that no cell has
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
    Make the plan seed by seed, so that a matrix that is stopped early has runs of every cell.

    :param scale: fraction of the suite's steps
    :param logs: folder of all runs; each scale, or number of steps, has its own subfolder
    """
    missing = {f"{cell.algo} on {cell.env_id}": _why_missing(cell) for cell in cells}
    possible = [cell for cell in cells if not missing[f"{cell.algo} on {cell.env_id}"]]
    found = {}
    for seed in seeds:
        for job in (make_job(cell, seed, scale, logs) for cell in possible):
            found[job.logs, job.algo, job.env_id] = job
    return Plan(list(found.values()), [f"{what}: {why}" for what, why in missing.items() if why])


def make_job(cell: Cell, seed: int, scale: float, logs: Path) -> Job:
    """
    Make the job of a cell and a seed.

    Settings of the cell that equal those of ``hyperparams/`` or a default are left out, so that equal cells of two
    suites are one job.
    """
    entry, _ = read_entry(hyperparams_file(cell.algo), cell.env_id)
    implied = {**default_settings(cell.algo), **entry}
    settings = {key: value for key, value in cell.settings.items() if not same_settings(implied.get(key), value)}
    variant = ",".join(f"{key}={value}" for key, value in settings.items())
    n_timesteps = max(round(scale * (cell.n_timesteps or entry["n_timesteps"])), 1)
    if "learning_starts" in settings and entry.get("learning_starts"):  # as long as before, compared with the control's
        shortened = shorten_warm_up(entry["learning_starts"], n_timesteps) / entry["learning_starts"]
        settings["learning_starts"] = round(shortened * settings["learning_starts"])
    length = f"steps_{n_timesteps}" if cell.n_timesteps else f"scale_{scale:g}"
    return Job(
        cell.algo,
        cell.env_id,
        seed,
        n_timesteps=n_timesteps,
        logs=logs.resolve() / length / variant / f"seed_{seed}",
        settings=settings,
    )


def _why_missing(cell: Cell) -> str:
    """Return why a cell cannot be run here, or ""."""
    if cell.algo not in KNOWN_ALGORITHMS:
        return f"this version of the package has no {cell.algo.upper()}"
    if simulator_of(cell.env_id).make_vec is not None:
        return "it has no evaluations, and a simulation of its own on a GPU: train it by sb3-tdc train"
    try:
        require_env(cell.env_id)
    except ValueError as error:
        return str(error)
    return ""


def estimate_seconds(seconds: Iterable[float], n_jobs: int) -> float:
    """Return the time until all jobs have ended, if the first free one of ``n_jobs`` workers takes each."""
    free_at = [0.0] * n_jobs
    for duration in seconds:
        heapq.heappush(free_at, heapq.heappop(free_at) + duration)
    return max(free_at)


def dry_run(plan: Plan, rates: Mapping[tuple[str, str], float], n_jobs: int) -> None:
    """Print for every job whether it would be run, resumed or skipped, and the time that all would take."""
    rates, seconds = dict(rates), []
    for job in plan.jobs:
        key, done = (job.algo, job.env_id), job.steps_done
        verb = "skip" if job.is_finished else "run" if job.run_folder is None else "resume"
        print(f"{verb:6} {job}, {job.n_timesteps:,} steps" + (f", {done:,} done" if verb == "resume" else ""))
        if verb != "skip":
            if key not in rates:
                rates[key] = measure_rate(job)
                print(f"       {rates[key]:.0f} steps/s, of {MEASURED_STEPS} steps, without evaluations")
            seconds.append((job.n_timesteps - done) / rates[key])
    total = timedelta(seconds=round(estimate_seconds(seconds, n_jobs)))
    print(f"{len(seconds)} of {len(plan.jobs)} to run, {n_jobs} at once: about {total} (hours:minutes:seconds)")
