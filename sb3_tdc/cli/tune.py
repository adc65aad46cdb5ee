"""``sb3-tdc tune --algo tdc --env Hopper-v4``: search λ or other hyperparameters with Ray Tune."""

import argparse
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from sb3_tdc.cli.arguments import Parser, add_settings, one_of
from sb3_tdc.common import plain_yaml
from sb3_tdc.common.commands import command
from sb3_tdc.common.files import check_can_be_made, lock, numbered, write_atomically
from sb3_tdc.common.output import harmless_output
from sb3_tdc.common.words import count
from sb3_tdc.envs.registry import split_env_id
from sb3_tdc.experiments.jobs import Job, cluster, eval_freq
from sb3_tdc.experiments.ranking import write_results
from sb3_tdc.experiments.search import make_candidate_jobs
from sb3_tdc.experiments.trials import make_trials, read_shared_evaluations, run_trials
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS
from sb3_tdc.runs.folder import folder_name
from sb3_tdc.runs.settings import plain_arguments
from sb3_tdc.safe_load.regular_files import read_text

_ARGUMENTS = "search.yml"
_MAX_BYTES = 2**20
_OF_THE_PROCESS = ("resume", "jobs", "address")


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser("tune", "Search hyperparameters (by default λ, among the paper's ten) by early evaluation returns.")
    add = parser.add_argument
    add_settings(parser, ["algo", "env", "gym_packages", "hyperparams"])
    parser.set_defaults(env="Hopper-v4")
    add("-n", "--n-timesteps", type=int, default=100_000, metavar="STEPS", help="environment steps of a trial")
    add("--seeds", type=int, default=3, metavar="N", help="number of seeds of each candidate: 1, 2, ..., N")
    add(
        "--search",
        nargs="+",
        default=[],
        metavar="KEY:VALUES",
        help='hyperparameters to search, e.g. "lam:[0.5,1.0]" "tau:loguniform(1e-4,1e-2)"',
    )
    add("--samples", type=int, default=10, metavar="N", help="candidates to draw from the distributions in --search")
    add("--asha", action="store_true", help="stop the worse two thirds of the candidates early, twice")
    add("--logs", type=Path, default=Path("logs"), metavar="FOLDER", help="folder of all searches")
    add(
        "--jobs",
        type=int,
        metavar="N",
        help="CPUs to use (default: all cores); a trial takes one, with --asha one for each seed",
    )
    add(
        "--address",
        metavar="HOST:PORT",
        help="address of a Ray cluster that shares this file system (default: this machine)",
    )
    add(
        "--resume",
        type=Path,
        metavar="FOLDER",
        help="continue an interrupted search; its folder holds the other arguments",
    )
    return parser


def _read_arguments(args: argparse.Namespace, given: dict[str, Any]) -> None:
    """
    Replace the arguments with those of the search that is resumed.

    :raises ValueError: if there is no such search, its file is damaged, or the command line contradicts it
    """
    stored = _read_stored(args.resume / _ARGUMENTS)
    for name, value in given.items():
        if name in stored and str(value) != str(stored[name]):
            raise ValueError(
                f"--{name.replace('_', '-')} {value} contradicts the search in {args.resume}: {stored[name]}"
            )
    vars(args).update(stored)
    args.folder = args.resume.resolve()


def _read_stored(path: Path) -> dict[str, Any]:
    """
    Read the stored arguments of a search; those of a single process (``--jobs``, ``--address``) are not part of it.

    :raises ValueError: if an argument is missing, or has a value that the command line would not produce
    """
    if not path.is_file():
        raise ValueError(f"{path.parent} is not the folder of a search: it has no {path.name}")
    stored = plain_yaml.load(read_text(path, _MAX_BYTES), str(path))
    if not isinstance(stored, dict):
        raise ValueError(f"{path} must be a mapping of arguments to values")
    defaults = plain_arguments(vars(make_parser().parse_args([])))
    arguments = {name: stored.get(name) for name in defaults if name not in _OF_THE_PROCESS}
    for name, value in arguments.items():
        kind = type(defaults[name])
        if type(value) is not kind:
            raise ValueError(f"{path}: {name} must be of type {kind.__name__}, got {value!r}")
        if isinstance(value, (list, dict)) and not all(isinstance(each, str) for each in value):
            raise ValueError(f"{path}: {name} must hold texts, got {value!r}")
    try:
        one_of("algorithm", KNOWN_ALGORITHMS)(str(arguments["algo"]))
    except argparse.ArgumentTypeError as error:
        raise ValueError(f"{path}: {error}") from error
    return arguments


def _make_folder(args: argparse.Namespace) -> Path:
    """Return the folder for a new search, with the next free number; it is not made yet."""
    parent = args.logs.resolve() / "search" / args.algo
    name = folder_name(args.env)
    folder = parent / f"{name}_{max(numbered(parent, name), default=0) + 1}"
    check_can_be_made("--logs", folder)
    return folder


def _lock(folder: Path) -> Any:
    """
    Keep other processes out of a search.

    :return: the locked file, which must stay open as long as the search lasts
    :raises ValueError: if another process runs the search
    """
    locked = lock(folder / _ARGUMENTS)
    if locked is None:
        raise ValueError(f"Another process runs the search in {folder}")
    return locked


@harmless_output()
def main(argv: Sequence[str] | None = None) -> int:
    """
    Search hyperparameters.

    :param argv: arguments; by default, those of the process
    :return: 0, 1 if a trial failed, 130 if the user stopped the search
    """
    parser = make_parser()
    args, given = parser.parse_args(argv), parser.parse_given(argv)
    try:
        return _search(args, given)
    except ValueError as error:
        parser.fail(error)


def _search(args: argparse.Namespace, given: dict[str, Any]) -> int:
    """
    Check the arguments, make and lock the folder of the search, and run it.

    :return: the exit status
    :raises ValueError: if an argument is not allowed, before any file is written
    """
    if args.resume is not None:
        _read_arguments(args, given)
    typed = plain_arguments(vars(args))
    args.env, args.gym_packages = split_env_id(args.env, args.gym_packages)
    if args.resume is None:
        args.folder = _make_folder(args)
    candidates = make_candidate_jobs(args)
    with ExitStack() as stack:
        if args.resume is not None:
            stack.enter_context(_lock(args.folder))
        stack.enter_context(cluster(args.address, args.jobs))
        if args.resume is None:
            args.folder.mkdir(parents=True)
            write_atomically(lambda part: part.write_text(plain_yaml.dump(typed)), args.folder / _ARGUMENTS)
            stack.enter_context(_lock(args.folder))
        return _run(args, candidates)


def _run(args: argparse.Namespace, candidates: Sequence[Sequence[Job]]) -> int:
    """
    Train the candidates, and rank them if all trials have ended.

    :return: the exit status
    """
    print(
        f"{count(len(candidates), 'candidate')} × {count(args.seeds, 'seed')}, {count(args.n_timesteps, 'step')} each, "
        f"evaluated every {eval_freq(args.n_timesteps):,} (5 episodes); one CPU and one thread a seed; "
        f"in {args.folder}",
        flush=True,
    )
    try:
        is_complete, failed = run_trials(args, make_trials(candidates, args.searched, args.asha))
    except KeyboardInterrupt:
        is_complete, failed = False, []
    for sentence in failed:
        print(f"failed {sentence}", file=sys.stderr)
    if not is_complete:
        print(f"Stopped. To continue:\n  {command('tune', '--resume', args.folder)}", file=sys.stderr)
        return 130
    if any(len(read_shared_evaluations(jobs)[0]) for jobs in candidates):
        write_results(args.folder, candidates, args.searched)
    return int(bool(failed))
