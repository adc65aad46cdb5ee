"""``sb3-tdc publish LOGS``: copy the small files of finished runs into a folder that can be committed."""

import sys
from collections.abc import Sequence
from pathlib import Path

from sb3_tdc.cli.arguments import Parser
from sb3_tdc.common.commands import command
from sb3_tdc.common.files import check_can_be_made
from sb3_tdc.experiments import final_episodes as test_returns
from sb3_tdc.experiments.publish import RESULTS, publish
from sb3_tdc.experiments.results import Run, find_runs
from sb3_tdc.runs.trained import flags_to_open


def main(argv: Sequence[str] | None = None) -> int:
    """
    Copy the small files of finished runs.

    :param argv: arguments; by default, those of the process
    :return: 0, or 1 if there is nothing to publish, a published run has no test episodes yet, or a run is refused
        because another one is in its place
    """
    parser = Parser(
        "publish", "Copy the small files of all finished runs: evaluations, settings, versions, test returns, the log."
    )
    parser.add_argument("logs", type=Path, help="folder of runs")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="folder to write to")
    args = parser.parse_args(argv)
    try:
        runs, unreadable = find_runs(args.logs)
        check_can_be_made("-o", args.output)
        if args.output.resolve().is_relative_to(args.logs.resolve()):
            raise ValueError(f"-o must not lie in the folder of the runs, {args.logs}, got {args.output}")
    except ValueError as error:
        parser.fail(error)
    to_publish = [run for run in runs if run.is_finished and run.evaluations is not None]
    if not to_publish:
        print(f"Nothing to publish: {args.logs} has no run that is finished and evaluated", file=sys.stderr)
    untested: dict[Path, Run] = {}
    refused = []
    for run in to_publish:
        try:
            place = publish(run, args.logs, args.output)
        except ValueError as error:
            refused.append(f"{run.folder.path} is not published: {error}")
            continue
        size = sum(path.stat().st_size for path in place.rglob("*") if path.is_file())
        print(f"{place}: {size / 1000:.0f} kB")
        if test_returns.read_test_returns(run) is None:
            untested[place] = run
    for text in [*unreadable, *refused]:
        print(text, file=sys.stderr)
    if untested:
        play = command("evaluate", args.logs, *flags_to_open(run.folder for run in untested.values()))
        print(f"Without test episodes: {', '.join(map(str, untested))} ({play})")
    return int(bool(untested or refused) or not to_publish)
