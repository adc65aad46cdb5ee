"""``sb3-tdc evaluate LOGS``: test episodes of every finished run."""

import sys
from collections.abc import Sequence
from pathlib import Path

from sb3_tdc.cli.arguments import Parser, add_settings, add_trust, warn_about_trust
from sb3_tdc.common.words import count
from sb3_tdc.experiments.final_episodes import EPISODES, measure_run
from sb3_tdc.experiments.results import find_runs


def main(argv: Sequence[str] | None = None) -> int:
    """
    Play test episodes with every finished run.

    :param argv: arguments; by default, those of the process
    :return: 0, or 1 if a run could not be tested
    """
    parser = Parser("evaluate", "Play test episodes with every finished run; what has been played is not played again.")
    parser.add_argument("logs", type=Path, help="folder of runs")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="episodes for each run")
    add_settings(parser, ["gym_packages"])
    add_trust(parser)
    args = parser.parse_args(argv)
    if args.episodes < 1:
        parser.error(f"--episodes must be at least 1, got {args.episodes}")
    try:
        runs, unreadable = find_runs(args.logs)
    except ValueError as error:
        parser.fail(error)
    warn_about_trust(args.trust)
    failed = list(unreadable)
    for run in runs:
        if not run.is_finished:
            print(f"{run.folder.path}: left out, at step {run.steps:,} of {run.n_timesteps:,}")
            continue
        try:
            returns = measure_run(run, args.episodes, args.gym_packages, args.trust)
        except Exception as error:  # one run must not stop the others
            failed.append(f"{run.folder.path}: {type(error).__name__}: {' '.join(str(error).split())}")
            continue
        print(
            f"{run.folder.path}: {returns.mean():.1f} ± {returns.std():.1f} ({count(len(returns), 'episode')})",
            flush=True,
        )
    for sentence in failed:
        print(f"Failed: {sentence}", file=sys.stderr)
    return int(bool(failed))
