"""``sb3-tdc train --algo tdc --env Walker2d-v4``: arguments and messages; ``runs/training.py`` has the training."""

import sys
import time
from collections.abc import Sequence
from datetime import timedelta

from sb3_tdc.cli.arguments import Parser, add_all_settings, warn_about_trust
from sb3_tdc.common.commands import command
from sb3_tdc.common.finite import NonFiniteError
from sb3_tdc.common.output import harmless_output, warnings_as_sentences
from sb3_tdc.resume import LockedError, NotRestoredError, stored_steps
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.runs.models import needs_trust
from sb3_tdc.runs.settings import RunSettings
from sb3_tdc.runs.setup import make_run, resume_run
from sb3_tdc.runs.trained import flags_to_open
from sb3_tdc.runs.training import NotSavedError, SetupError, TrainingError, TrainingOutcome, TrainingRun, train

_TUNE = "to search hyperparameters: sb3-tdc tune (--search, --samples, --seeds, --jobs)"
_TRACK = "a run writes TensorBoard files into its folder; `wandb sync` uploads them"
# Flags that users of RL Zoo type by habit, with their replacements here
_ZOO_FLAGS = {
    **dict.fromkeys(
        (
            *("-optimize", "--optimize-hyperparameters", "--optimization-log-path", "--n-trials", "--max-total-trials"),
            *("--n-jobs", "-n-jobs", "--sampler", "--pruner", "--n-startup-trials", "--n-evaluations", "--storage"),
            *("--study-name", "--trial-id", "--no-optim-plots"),
        ),
        _TUNE,
    ),
    **dict.fromkeys(
        ("--track", "--wandb-project-name", "--wandb-entity", "--wandb-group", "-tags", "--wandb-tags"), _TRACK
    ),
    "--truncate-last-trajectory": "with -i and a replay buffer, the last episode in it always ends where it was saved",
    "--n-envs": "environments are a hyperparameter, -params n_envs:4",
    "--norm-reward": "normalisation is a hyperparameter, -params normalize:true",
    "--yaml-file": "--conf-file FILE",
    "--deterministic": "evaluations always take the mean action",
}


def make_parser() -> Parser:
    """Return the parser of RL Zoo's flags, with its names and meanings."""
    parser = Parser(
        "train", "Train an agent. Hyperparameters come from hyperparams/<algo>.yml, as in RL Zoo.", _ZOO_FLAGS
    )
    add_all_settings(parser)
    return parser


def _has_tqdm(verbose: int) -> bool:
    try:
        import tqdm  # noqa: F401
    except ImportError:
        if verbose > 0:
            print('For a progress bar: pip install "sb3-tdc[progress]"')
        return False
    return True


def main(argv: Sequence[str] | None = None) -> int:
    """
    Train, or resume a run.

    :param argv: arguments; by default, those of the process
    :return: 0, 1 if training failed or the model could not be saved, 130 if the user stopped it
    """
    with harmless_output(), warnings_as_sentences():
        return _main(argv)


def _main(argv: Sequence[str] | None) -> int:
    parser = make_parser()
    settings, given = RunSettings(**vars(parser.parse_args(argv))), parser.parse_given(argv)
    start = time.monotonic()
    warn_about_trust(settings.trust)
    try:
        run = make_run(settings) if settings.resume is None else resume_run(given)
    except ValueError as error:
        parser.fail(error)
    if run is None:
        print(f"{settings.resume} is finished: there is nothing to resume")
        return 0
    settings, folder = run.settings, run.folder
    if settings.progress is None:
        settings.progress = sys.stderr.isatty() and _has_tqdm(settings.verbose)
    try:
        outcome = train(run)
    except (SetupError, NotRestoredError) as error:
        if isinstance(error.__cause__, KeyboardInterrupt):
            print(error, file=sys.stderr)
            return 130
        parser.fail(error)
    except (TrainingError, NotSavedError, LockedError, NonFiniteError, KeyboardInterrupt) as error:
        return _report_failure(error, folder)
    if settings.verbose > 0:
        print(f"Saved {folder.model} after {timedelta(seconds=round(time.monotonic() - start))}")
    if outcome.interrupted:
        _print_how_to_continue(argv, run, outcome)
        return 130
    if settings.verbose > 0:
        print(f"To watch it: {command('enjoy', folder.path, *flags_to_open([folder]))}")
    return 0


def _report_failure(error: BaseException, folder: RunFolder) -> int:
    """
    Print why a run ended and what to do.

    :return: the exit status
    """
    if isinstance(error, KeyboardInterrupt):
        print(f"Stopped without saving; what was saved before stays in {folder.path}", file=sys.stderr)
        return 130
    print(error, file=sys.stderr)
    steps = stored_steps(folder.resume_folder)
    if isinstance(error, NonFiniteError):
        print(f"What was saved before stays in {folder.path}", file=sys.stderr)
        if steps:
            print(
                f"To go back to an earlier step ({', '.join(map(str, steps))}), for instance with another learning "
                f"rate:\n  {folder.command_to_resume} --from {steps[-1]} -params learning_rate:1.0e-4",
                file=sys.stderr,
            )
        return 1
    if isinstance(error, TrainingError):
        print(f"The traceback is in {folder.error}", file=sys.stderr)
    if steps:
        print(f"To continue from the newest resume state:\n  {folder.command_to_resume}", file=sys.stderr)
    return 1


def _print_how_to_continue(argv: Sequence[str] | None, run: TrainingRun, outcome: TrainingOutcome) -> None:
    steps, total, folder = outcome.model.num_timesteps, run.hyperparams.n_timesteps, run.folder
    if outcome.resume_step is not None:
        print(f"Stopped at step {steps:,} of {total:,}. To continue from step {outcome.resume_step:,}:")
        print(f"  {folder.command_to_resume}")
    else:
        with_buffer = run.settings.save_replay_buffer
        experience = "with" if with_buffer else "without (--save-replay-buffer keeps it)"
        print(f"Stopped at step {steps:,} of {total:,}. To continue in a new run, {experience} the replay buffer:")
        print(f"  {_command_to_continue(argv, run, total - steps)}")


def _command_to_continue(argv: Sequence[str] | None, run: TrainingRun, n_timesteps: int) -> str:
    """Return this command with a new number of steps, and the saved model to start from."""
    without = Parser("")
    without.add_argument("-n", "--n-timesteps")
    without.add_argument("-i", "--trained-agent")
    without.add_argument("--trust", action="store_true")
    _, others = without.parse_known_args(sys.argv[1:] if argv is None else argv)
    trust = ["--trust"] if needs_trust(run.folder.model, run.settings.algo) else []
    return command("train", "-n", n_timesteps, "-i", run.folder.model, *trust, *others)
