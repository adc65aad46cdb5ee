"""``sb3-tdc matrix SUITE``: train the runs of a suite, several at once; the same command resumes stopped ones."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sb3_tdc.cli.arguments import Names, Parser, one_of
from sb3_tdc.common.commands import command
from sb3_tdc.common.files import check_can_be_made
from sb3_tdc.common.output import harmless_output
from sb3_tdc.experiments.jobs import Job, cluster, count_cores
from sb3_tdc.experiments.matrix import run_jobs
from sb3_tdc.experiments.plan import Plan, dry_run, make_plan, select
from sb3_tdc.experiments.publish import RESULTS
from sb3_tdc.experiments.rates import read_rates
from sb3_tdc.experiments.suites import PAPER, SUITES


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser("matrix", "Train the runs of a figure of the paper; skip finished ones, resume stopped ones.")
    add = parser.add_argument
    add("suite", type=one_of("suite", [*SUITES, "all"]), help=f"{', '.join(SUITES)}, or all of the paper's")
    add(
        "--seeds", type=int, nargs="+", default=[5], metavar="N", help="number of seeds, or the seeds (several numbers)"
    )
    add("--scale", type=float, default=1.0, help="fraction of the suite's environment steps")
    add("--only", nargs="+", action=Names, default=[], metavar="NAME", help="algorithms and environments to train")
    add("--logs", type=Path, default=Path("logs"), help="folder of all runs")
    add("--results", type=Path, default=RESULTS, help="folder of published results: runs that are there are skipped")
    add("--retrain", action="store_true", help="train runs that are in the folder of published results, too")
    add("--jobs", type=int, metavar="N", help="runs at once (default: one for each core)")
    add(
        "--address",
        metavar="HOST:PORT",
        help="address of a Ray cluster that shares this file system (default: this machine)",
    )
    add("--dry-run", action="store_true", help="print what would be run, and how long it would take")
    return parser


def _plan(args: argparse.Namespace) -> Plan:
    """
    Make the plan that the arguments describe.

    :raises ValueError: if an argument is not allowed
    """
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
    """Return the plan without the jobs that have published results."""

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
            "steps); random steps at the start: as in the paper, but at most a tenth of a run; where a suite varies "
            "them, in the same proportion."
        )


@harmless_output()
def main(argv: Sequence[str] | None = None) -> int:
    """
    Train the runs of a suite.

    :param argv: arguments; by default, those of the process
    :return: 0 if all runs that can be trained are finished, 1 if one failed, 130 if the user stopped the command
    """
    parser = make_parser()
    args = parser.parse_args(argv)
    try:
        whole = _plan(args)
        plan = whole if args.retrain else _without_published(whole, args)
        to_run = [job for job in plan.jobs if not job.is_finished]
        _describe(args, plan)
        if args.dry_run:
            dry_run(plan, read_rates(args.logs), args.jobs or count_cores())
            return 0
        print(f"{len(plan.jobs) - len(to_run)} of {len(plan.jobs)} runs are finished already", flush=True)
        if not to_run:
            return 0
        check_can_be_made("--logs", args.logs)
        with cluster(args.address, args.jobs) as ray:
            outcome = run_jobs(ray, to_run, args.jobs)
    except ValueError as error:
        parser.fail(error)
    for sentence in outcome.failed:
        print(f"failed {sentence}", file=sys.stderr)
    if outcome.stopped:
        print("To continue: the same command", file=sys.stderr)
        return 130
    published = [args.results] if len(plan.jobs) < len(whole.jobs) else []
    for folder in dict.fromkeys(args.logs / job.logs.relative_to(args.logs.resolve()).parts[0] for job in plan.jobs):
        print(f"To look at them: {command('report', *published, folder)}")
    return int(bool(outcome.failed))
