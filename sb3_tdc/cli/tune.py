"""``sb3-tdc tune --algo tdc --env Hopper-v4``: search λ, or other hyperparameters, on Ray Tune."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_tdc.cli.arguments import Parser, add_settings
from sb3_tdc.common import plain_yaml
from sb3_tdc.common.commands import command
from sb3_tdc.common.files import numbered
from sb3_tdc.envs.registry import import_packages, split_env_id
from sb3_tdc.experiments.jobs import cluster, eval_freq
from sb3_tdc.experiments.ranking import write_results
from sb3_tdc.experiments.search import make_candidate_jobs
from sb3_tdc.experiments.trials import make_trials, read_returns, run_trials
from sb3_tdc.runs.folder import folder_name
from sb3_tdc.runs.settings import plain_arguments

_ARGUMENTS = "search.yml"


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser("tune", "Search hyperparameters (by default λ, among the paper's ten) by early evaluation returns.")
    add = parser.add_argument
    add_settings(parser, ["algo", "env", "gym_packages", "hyperparams"])
    parser.set_defaults(env="Hopper-v4")
    add("-n", "--n-timesteps", type=int, default=100_000, help="environment steps of a trial")
    add("--seeds", type=int, default=3, help="seeds of each candidate: 1, 2, ...")
    add(
        "--search",
        nargs="+",
        default=[],
        metavar="KEY:VALUES",
        help='such as "lam:[0.5,1.0]" "tau:loguniform(1e-4,1e-2)"',
    )
    add("--samples", type=int, default=10, help="draws of the distributions in --search")
    add("--asha", action="store_true", help="stop the worse two thirds of the candidates early, twice")
    add("--logs", type=Path, default=Path("logs"), help="folder of all searches")
    add("--jobs", type=int, help="CPUs to use (default: all cores); a trial takes one, with --asha one a seed")
    add("--address", help="of a Ray cluster that shares this file system (default: this machine)")
    add("--resume", type=Path, metavar="FOLDER", help="continue a stopped search; it has all other arguments")
    return parser


def _read_arguments(args: argparse.Namespace, given: dict[str, Any]) -> None:
    """
    Those of a search that is resumed.

    :raises ValueError: if there is none, or the command line contradicts it
    """
    try:
        stored = plain_yaml.load((args.resume / _ARGUMENTS).read_text(), str(args.resume / _ARGUMENTS))
    except OSError as error:
        raise ValueError(f"{args.resume} is not the folder of a search: it has no readable {_ARGUMENTS}") from error
    of_the_process = ("resume", "jobs", "address")
    for name, value in given.items():
        if name not in of_the_process and str(value) != str(stored.get(name)):
            raise ValueError(f"--{name} {value} contradicts the search in {args.resume}: {stored.get(name)}")
    vars(args).update({name: value for name, value in stored.items() if name not in of_the_process})
    args.folder = args.resume.resolve()


def _make_folder(args: argparse.Namespace) -> Path:
    """Return the next free folder of a search; it does not exist yet."""
    parent = args.logs.resolve() / "search" / args.algo
    name = folder_name(args.env)
    return parent / f"{name}_{max(numbered(parent, name), default=0) + 1}"


def main(argv: Sequence[str] | None = None) -> int:
    """
    Search hyperparameters.

    :param argv: arguments, those of the process by default
    :return: 0, 1 if a trial failed, 130 if the user stopped the search
    """
    parser = make_parser()
    args, given = parser.parse_args(argv), parser.parse_given(argv)
    try:
        if args.resume is not None:
            _read_arguments(args, given)
        typed = plain_arguments(vars(args))
        args.env, args.gym_packages = split_env_id(args.env, args.gym_packages)
        import_packages(args.gym_packages)
        if args.resume is None:
            args.folder = _make_folder(args)
        candidates = make_candidate_jobs(args)
        trials = make_trials(candidates, args.searched, args.asha)
        with cluster(args.address, args.jobs):
            if args.resume is None:
                args.folder.mkdir(parents=True)
                (args.folder / _ARGUMENTS).write_text(plain_yaml.dump(typed))
            print(
                f"{len(candidates)} candidates × {args.seeds} seeds, {args.n_timesteps:,} steps each, evaluated every "
                f"{eval_freq(args.n_timesteps):,} (5 episodes); one CPU and one thread a seed; in {args.folder}",
                flush=True,
            )
            is_complete, failed = run_trials(args, trials)
    except ValueError as error:
        parser.fail(error)
    except KeyboardInterrupt:
        is_complete, failed = False, []
    for sentence in failed:
        print(f"failed {sentence}", file=sys.stderr)
    if not is_complete:
        print(f"Stopped. To continue:\n  {command('tune', '--resume', args.folder)}", file=sys.stderr)
        return 130
    if any(read_returns(jobs).size for jobs in candidates):
        write_results(args.folder, candidates, args.searched)
    return int(bool(failed))
