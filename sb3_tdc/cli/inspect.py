"""``sb3-tdc inspect FILE``: show the content of a saved file, the code in it, and whether it would be opened."""

import json
from collections.abc import Sequence
from pathlib import Path

from sb3_tdc.cli.arguments import Parser, one_of
from sb3_tdc.common.untrusted import escaped
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.safe_load.inspect import inspect
from sb3_tdc.safe_load.run_files import check_arguments, check_imports

_KINDS = "zip of a model, a pickle of VecNormalize statistics or of a replay buffer"


def inspect_run(path: Path) -> tuple[list[str], bool]:
    """
    Describe a run folder, with every model, statistics and replay buffer in it.

    :return: lines for the screen, and whether every file would be opened
    :raises ValueError: if it is not a run folder
    """
    run, algorithm = RunFolder.open(path), None
    lines, is_good = [f"{escaped(str(path))}: the folder of a run"], True
    try:
        args = run.args
        algorithm = KNOWN_ALGORITHMS.get(str(args.get("algo")))
        check_arguments(args, KNOWN_ALGORITHMS, str(path))
        check_imports(args, run.config, (), str(path))
        lines.append(f"  {escaped(json.dumps({name: args[name] for name in ('algo', 'env', 'gym_packages')}))}")
    except ValueError as error:
        lines, is_good = [*lines, f"Refused: {escaped(str(error))}"], False
    files = run.saved_files()
    if not any(file.suffix == ".zip" for file in files):
        lines, is_good = [*lines, "Refused: it has no models"], False
    for file in files:
        try:
            described, opens = inspect(file, algorithm)
        except ValueError as error:
            described, opens = [f"Refused: {escaped(str(error))}"], False
        lines, is_good = [*lines, "", *described], is_good and opens
    return lines, is_good


def main(argv: Sequence[str] | None = None) -> int:
    """
    Show the content of a saved file.

    :param argv: arguments; by default, those of the process
    :return: 0 if every file would be opened, 1 if one would be refused; other files and bad arguments exit with 2
    """
    parser = Parser("inspect", "Show what a saved file holds, what of it is code, and whether it would be opened.")
    parser.add_argument("path", type=Path, help=f"a {_KINDS}, or a run folder")
    parser.add_argument(
        "--algo",
        type=one_of("algorithm", KNOWN_ALGORITHMS),
        help="of the zip of a model (default: the one of its policy)",
    )
    args = parser.parse_args(argv)
    path = args.path
    if not path.exists():
        parser.error(f"{escaped(str(path))} does not exist")
    if path.is_dir() and args.algo is not None:
        parser.error("--algo is for the zip of a model: the folder of a run names its own")
    try:
        lines, is_good = inspect_run(path) if path.is_dir() else inspect(path, KNOWN_ALGORITHMS.get(args.algo))
    except ValueError as error:
        expected = "" if path.is_dir() else f"; it must be a {_KINDS}"
        parser.error(f"{escaped(str(error))}{expected}")
    print("\n".join(lines))
    return 0 if is_good else 1
