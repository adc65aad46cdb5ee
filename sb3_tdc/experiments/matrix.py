"""Training of the runs of a plan, several at once, on Ray."""

import sys
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

from sb3_tdc.experiments.jobs import Job, run

_SECONDS_TO_STOP = 60.0
_SECONDS_UNTIL_ASKED_AGAIN = 5.0


@dataclass
class MatrixOutcome:
    """
    How a matrix ended.

    :param failed: one sentence for each failed job
    :param stopped: whether the user stopped the matrix
    """

    failed: list[str]
    stopped: bool = False


def run_jobs(ray: Any, jobs: Sequence[Job], n_jobs: int | None) -> MatrixOutcome:
    """
    Run jobs, several at once.

    A job that another process trains is left to that process and checked again every few seconds. Once that process has
    ended, the job is resumed here, unless it is finished.

    :param ray: the Ray module, initialised
    :param n_jobs: number of jobs at once; None for one per CPU of Ray
    """
    # One CPU for each job, and one thread (in its arguments). If its machine is lost, Ray starts the job again, which
    # then resumes
    execute = ray.remote(num_cpus=1, max_retries=2)(run)
    queue, outcome = _Queue(jobs), MatrixOutcome([])
    running: dict[Any, tuple[Job, float]] = {}
    try:
        while queue or running:
            while len(running) < (n_jobs or int(ray.cluster_resources().get("CPU", 1))) and (job := queue.pop()):
                print(f"{'resume' if job.run_folder else 'run':6} {job}", flush=True)
                running[execute.remote(job)] = job, time.monotonic()
            for reference in _wait(ray, list(running)):
                job, start = running.pop(reference)
                why = _why_failed(ray, reference, job)
                if why is None:
                    queue.put_off(job)
                    continue
                outcome.failed += [f"{job}: {why}"] if why else []
                took = timedelta(seconds=round(time.monotonic() - start))
                result = "FAILED" if why else f"return {job.final_return:.1f}" if job.final_return is not None else ""
                progress = f"[{len(jobs) - len(queue) - len(running)}/{len(jobs)}]"
                print(f"end    {job}, {took}, {result} {progress}", flush=True)
    except KeyboardInterrupt:
        outcome.stopped = True
        print("\nStopping: the runs write their resume states.", file=sys.stderr, flush=True)
        for reference in running:
            ray.cancel(reference)
        if running:
            ray.wait(list(running), num_returns=len(running), timeout=_SECONDS_TO_STOP)
    return outcome


class _Queue:
    """A queue of jobs; a job that another process trains goes to its end, to be checked again after a few seconds."""

    def __init__(self, jobs: Sequence[Job]):
        self._jobs = deque((0.0, job) for job in jobs)  # with the time from which each may be started
        self._elsewhere: list[Job] = []

    def __len__(self) -> int:
        return len(self._jobs)

    def pop(self) -> Job | None:
        """Return the next job to start; None if none can be started now."""
        while self._jobs and self._jobs[0][0] <= time.monotonic():
            _, job = self._jobs.popleft()
            if job.is_trained_elsewhere:
                self.put_off(job)
            elif job.is_finished:
                print(f"end    {job}, by another process", flush=True)
            else:
                return job
        return None

    def put_off(self, job: Job) -> None:
        """Put back a job that another process trains."""
        if job not in self._elsewhere:
            self._elsewhere.append(job)
            print(f"wait   {job}: another process trains it", flush=True)
        self._jobs.append((time.monotonic() + _SECONDS_UNTIL_ASKED_AGAIN, job))


def _wait(ray: Any, references: list[Any]) -> list[Any]:
    """Return the references whose jobs have ended; waits for one second at most."""
    if not references:
        time.sleep(1.0)
        return []
    return ray.wait(references, timeout=1.0)[0]


def _why_failed(ray: Any, reference: Any, job: Job) -> str | None:
    """Return why a job failed, "" if it is finished, and None if another process trains it."""
    try:
        status = ray.get(reference)
    except ray.exceptions.RayError as error:
        return " ".join(str(error).split())
    if status is None:
        return None
    if status == 0 and job.is_finished:
        return ""
    return "\n  ".join([f"exit status {status}, see {job.log}", *job.last_lines()])
