"""``sb3-tdc report LOGS``: one page on all runs in one or several folders."""

from collections.abc import Sequence
from pathlib import Path

from sb3_tdc.cli.arguments import Parser
from sb3_tdc.common.files import check_writable
from sb3_tdc.experiments.report import write_report
from sb3_tdc.experiments.results import find_runs


def main(argv: Sequence[str] | None = None) -> int:
    """
    Make the report on folders of runs.

    :param argv: arguments; by default, those of the process
    :return: 0
    """
    parser = Parser("report", "Make one HTML page of all runs in some folders, with figures and tables next to it.")
    parser.add_argument(
        "logs", type=Path, nargs="+", help="folder of runs; of a seed that several have, the last counts"
    )
    parser.add_argument("-o", "--output", type=Path, help="folder to write to (report/ in the last folder of runs)")
    args = parser.parse_args(argv)
    try:
        runs, unreadable = find_runs(*args.logs)
    except ValueError as error:
        parser.fail(error)
    folder = args.output or args.logs[-1] / "report"
    try:
        check_writable("-o", folder / "report.html")
    except ValueError as error:
        parser.fail(error)
    path = write_report(runs, unreadable, folder)
    print(f"Wrote {path}, with figures/ and tables/ next to it")
    return 0
