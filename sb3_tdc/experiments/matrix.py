"""The runs of a plan, several at once on Ray."""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

from sb3_tdc.experiments.jobs import Job, run

_SECONDS_TO_STOP = 60.0


@dataclass
class MatrixOutcome:
    """
    How a matrix ended.

    :param failed: a sentence for each job that failed
    :param stopped: whether the user stopped the matrix
    """

    failed: list[str]
    stopped: bool = False


def run_jobs(ray: Any, jobs: Sequence[Job], n_jobs: int | None) -> MatrixOutcome:
    """
    Run jobs, several at once.

    :param ray: the module, initialised
    :param n_jobs: how many at once; None for as many as Ray has CPUs
    """
    # One CPU each, and one thread (in a job's arguments); a job whose machine is lost is started again, and resumes
    execute = ray.remote(num_cpus=1, max_retries=2)(run)
    waiting, outcome = list(reversed(jobs)), MatrixOutcome([])
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
        print("\nStopping: the runs write their resume states.", file=sys.stderr, flush=True)
        for reference in running:
            ray.cancel(reference)
        if running:
            ray.wait(list(running), num_returns=len(running), timeout=_SECONDS_TO_STOP)
    return outcome


def _why_failed(ray: Any, reference: Any, job: Job) -> str:
    """Return why a job failed, or "" if it is finished."""
    try:
        status = ray.get(reference)
    except ray.exceptions.RayError as error:
        return " ".join(str(error).split())
    if status == 0 and job.is_finished:
        return ""
    return "\n  ".join([f"exit status {status}, see {job.log}", *job.last_lines()])
