"""``python train.py --algo tdc --env Walker2d-v4``: arguments and messages; the run itself is in ``experiment``."""

import argparse
import os
import shlex
import shutil
import sys
import textwrap
import time
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.utils import set_random_seed

from sb3_tdc import plain_yaml
from sb3_tdc.arguments import MAX_SEED, KeyValues, Parser, add_common_arguments, apply_common_arguments, plain_arguments
from sb3_tdc.checkpoint import DEFAULT_FREQ, LockedError, NotRestoredError, stored_steps
from sb3_tdc.experiment import (
    ALGORITHMS,
    Experiment,
    NotSavedError,
    Outcome,
    SetupError,
    TrainingError,
    check_env_id,
    train,
)
from sb3_tdc.hyperparams import Hyperparams, hyperparams_file, parse, read_entry
from sb3_tdc.output import harmless_output
from sb3_tdc.run_folder import RunFolder
from sb3_tdc.tdc import NonFiniteError

_TUNE = "to search hyperparameters: python tune.py (--search, --samples, --seeds, --jobs)"
_TRACK = "a run writes TensorBoard files into its folder; `wandb sync` uploads them"
# What users of RL Zoo type by habit
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
    "--truncate-last-trajectory": "with -i and a replay buffer, the episode under way always ends where it was saved",
    "--n-envs": "environments are a hyperparameter, -params n_envs:4",
    "--norm-reward": "normalisation is a hyperparameter, -params normalize:true",
    "--yaml-file": "--conf-file FILE",
    "--deterministic": "evaluations always take the mean action",
}


def make_parser() -> Parser:
    """:return: RL Zoo's flags, names and meanings"""
    parser = Parser("Train an agent. Hyperparameters come from hyperparams/<algo>.yml, as in RL Zoo.", _ZOO_FLAGS)
    add_common_arguments(parser, ALGORITHMS)
    add = parser.add_argument
    add("--env", default="HalfCheetah-v4", help="environment id")
    add("-n", "--n-timesteps", type=int, default=-1, help="environment steps (-1: as in the hyperparameters)")
    add("--seed", type=int, default=-1, help="seed of all generators (-1: a random one)")
    add("-i", "--trained-agent", type=Path, help="zip of a model to go on from")
    add("--trust", action="store_true", help="let the files of -i run code, as SB3 does")
    add("--eval-freq", type=int, default=20_000, help="evaluate every so many steps (-1: never)")
    add("--eval-episodes", type=int, default=5, help="episodes per evaluation")
    add("--n-eval-envs", type=int, default=1, help="environments for evaluation")
    add("--save-freq", type=int, default=-1, help="save the model every so many steps (-1: only at the end)")
    add("--checkpoint-freq", type=int, default=DEFAULT_FREQ, help="steps between checkpoints to resume from (-1: none)")
    add("--resume", type=Path, metavar="RUN_FOLDER", help="go on with a stopped run; it has all other arguments")
    add("--from", dest="from_step", type=int, metavar="STEP", help="with --resume: go back to the checkpoint of a step")
    add(
        "--start-over",
        action="store_true",
        help="with --resume: begin at step 0 again, and overwrite the results",
    )
    add("--save-replay-buffer", action="store_true", help="save the replay buffer with the model")
    add("--log-interval", type=int, default=-1, help="episodes between log entries (-1: 4, 0: no log)")
    add("-tb", "--tensorboard-log", help='TensorBoard folder (none given: the run\'s own; "": off)')
    add("--vec-env", choices=["dummy", "subproc"], default="dummy", help="environments in this process or in their own")
    add("--eval-env-kwargs", nargs="+", action=KeyValues, default={}, help="key:value of the evaluation environment")
    add("-params", "--hyperparams", nargs="+", action=KeyValues, default={}, help="key:value over the hyperparameters")
    add("-conf", "--conf-file", type=Path, help="YAML file of hyperparameters (default: hyperparams/<algo>.yml)")
    add("-uuid", "--uuid", action="store_true", help="a unique name for the run folder")
    bar = parser.add_mutually_exclusive_group()
    bar.add_argument(
        "-P", "--progress", action="store_true", default=None, help="a progress bar (on a terminal: default)"
    )
    bar.add_argument("--no-progress", dest="progress", action="store_false", help="plain lines, also on a terminal")
    add("--verbose", type=int, default=1, help="0: silent, 1: progress, 2: also SB3's tables and messages")
    return parser


def read_hyperparams(args: argparse.Namespace) -> Hyperparams:
    """The entry of the environment, overruled by ``-params`` and ``-n``, validated; said on screen."""
    path = args.conf_file or hyperparams_file(args.algo)
    entry, name = read_entry(path, args.env)
    overrides = {**args.hyperparams, **({"n_timesteps": args.n_timesteps} if args.n_timesteps > 0 else {})}
    algorithm = ALGORITHMS[args.algo]
    where = f"{path}, {name}"
    parse({"n_timesteps": 1, **entry}, algorithm, where)  # so that an error names its source
    parse({"n_timesteps": 1, **overrides}, algorithm, "command line (-params)")
    hyperparams = parse({**entry, **overrides}, algorithm, where)
    if args.verbose > 0:
        nearest = "" if name == "default" else "; this is the nearest version"
        print(f"Hyperparameters: {where}{'' if name == args.env else f' (it has no entry for {args.env}{nearest})'}")
        print(textwrap.indent(plain_yaml.dump(hyperparams.raw, sort_keys=False), "  "), end="")
    return hyperparams


def make_experiment(args: argparse.Namespace) -> Experiment:
    """
    Check everything that can be checked, then make the run folder.

    :raises ValueError: for anything that is not allowed
    """
    if args.from_step is not None or args.start_over:
        raise ValueError(f"{'--start-over' if args.start_over else '--from'} goes with --resume RUN_FOLDER")
    args.env = apply_common_arguments(args, args.env)
    check_env_id(args.env)
    if args.n_timesteps < 1 and args.n_timesteps != -1:
        raise ValueError(f"-n must be at least 1 (or -1: as in the hyperparameters), got {args.n_timesteps}")
    for name in ("eval_episodes", "n_eval_envs"):
        if getattr(args, name) < 1:
            raise ValueError(f"--{name.replace('_', '-')} must be at least 1, got {getattr(args, name)}")
    if args.trained_agent is not None and not (args.trained_agent.suffix == ".zip" and args.trained_agent.is_file()):
        raise ValueError(f"-i must be the zip of a model, got {args.trained_agent}")
    if not -1 <= args.seed <= MAX_SEED:
        raise ValueError(f"--seed must be 0 to {MAX_SEED} (or -1: a random one), got {args.seed}")
    if args.seed < 0:
        args.seed = int(np.random.randint(MAX_SEED))
    hyperparams = read_hyperparams(args)
    vars(args).update(_absolute(vars(args)))
    folder = _make_folder(args, hyperparams)
    return _experiment(args, hyperparams, folder)


def _make_folder(args: argparse.Namespace, hyperparams: Hyperparams) -> RunFolder:
    """
    Make the run folder, with everything that the run is resumed from.

    :raises ValueError: if it cannot be written; nothing of it stays
    """
    folder = None
    try:
        folder = RunFolder.create(args.log_folder, args.algo, args.env, args.uuid)
        folder.write_config(hyperparams.raw, plain_arguments(vars(args)))
        if args.trained_agent is not None:
            shutil.copyfile(args.trained_agent, folder.trained_agent)
    except OSError as error:
        if folder is not None:
            shutil.rmtree(folder.path, ignore_errors=True)
        raise ValueError(f"No run folder can be made in {args.log_folder}: {error}") from error
    return folder


def _absolute(arguments: dict[str, Any]) -> dict[str, Any]:
    """Return the locations among arguments as they are found from any working directory."""
    locations = {name: arguments[name] for name in ("trained_agent", "tensorboard_log") if arguments.get(name)}
    return {name: type(location)(os.path.abspath(location)) for name, location in locations.items()}


def resume_experiment(args: argparse.Namespace, given: dict[str, Any]) -> Experiment | None:
    """
    The experiment of a run folder, and in ``args`` its arguments.

    :param given: what the command line says
    :return: None if the run is finished
    :raises ValueError: if there is nothing to resume, or an argument contradicts the run's
    """
    folder = RunFolder.open(args.resume)
    if not (folder.path / folder.env_name / "args.yml").is_file():
        raise ValueError(f"{folder.path} was stopped before its run began: start it anew")
    stored = folder.args
    given = {**given, **_absolute(given)}
    for name, value in plain_arguments(given).items():
        if name not in (*_OF_THE_PROCESS, *_OF_RESUMING) and value != stored.get(name, value):
            flag = f"--{name.replace('_', '-')}"
            raise ValueError(f"{flag} {value} contradicts the run in {folder.path}: {flag} {stored[name]}")
    changed = given.get("hyperparams", {})
    resumed = {**stored, **{name: value for name, value in given.items() if name in (*_OF_THE_PROCESS, *_OF_RESUMING)}}
    vars(args).update(resumed)
    if folder.is_finished:
        return None
    if stored.get("checkpoint_freq", 0) <= 0:
        raise ValueError(f"{folder.path} has no checkpoints: it was made without --checkpoint-freq")
    has_state = bool(stored_steps(folder.checkpoint_folder)) and not args.start_over
    if folder.has_results and not has_state and not args.start_over:
        raise ValueError(
            f"{folder.path} has results, but {folder.checkpoint_folder} has no checkpoints: "
            "--start-over begins at step 0 again, and overwrites the results"
        )
    if args.trained_agent is not None:
        args.trained_agent = folder.trained_agent if has_state else Path(args.trained_agent)
    apply_common_arguments(args, args.env)
    check_env_id(args.env)
    where, config = str(folder.path / folder.env_name / "config.yml"), folder.config
    differing = {name: value for name, value in changed.items() if name not in config or config[name] != value}
    parse({"n_timesteps": 1, **differing}, ALGORITHMS[args.algo], "command line (-params)")
    hyperparams = parse({**config, **differing}, ALGORITHMS[args.algo], where)
    return _experiment(args, hyperparams, folder, tuple(differing))


# What may differ when a run is resumed, and what is said only then; hyperparameters may too, and are recorded
_OF_THE_PROCESS = ("num_threads", "device", "verbose", "progress")
_OF_RESUMING = ("resume", "from_step", "start_over", "hyperparams")


def _experiment(
    args: argparse.Namespace, hyperparams: Hyperparams, folder: RunFolder, changed: tuple[str, ...] = ()
) -> Experiment:
    set_random_seed(args.seed)
    progress_bar = args.progress
    if progress_bar is None:
        progress_bar = sys.stderr.isatty() and _has_tqdm(args.verbose)
    return Experiment(
        algo=args.algo,
        env_id=args.env,
        hyperparams=hyperparams,
        folder=folder,
        seed=args.seed,
        eval_freq=args.eval_freq,
        eval_episodes=args.eval_episodes,
        n_eval_envs=args.n_eval_envs,
        save_freq=args.save_freq,
        save_replay_buffer=args.save_replay_buffer,
        checkpoint_freq=args.checkpoint_freq,
        resume=args.resume is not None,
        from_step=args.from_step,
        start_over=args.start_over,
        changed=changed,
        vec_env=args.vec_env,
        device=args.device,
        env_kwargs=args.env_kwargs,
        eval_env_kwargs=args.eval_env_kwargs,
        tensorboard_log=args.tensorboard_log,
        trained_model=args.trained_agent,
        trust=args.trust,
        log_interval=4 if args.log_interval == -1 else max(args.log_interval, 0) or None,
        progress_bar=progress_bar,
        verbose=args.verbose,
    )


def _has_tqdm(verbose: int) -> bool:
    try:
        import tqdm  # noqa: F401
    except ImportError:
        if verbose > 0:
            print('For a progress bar: pip install "sb3-tdc[progress]"')
        return False
    return True


def _command_to_go_on(argv: Sequence[str] | None, n_timesteps: int, model: Path) -> str:
    """The arguments of this run, but for the number of steps and the model to start from."""
    without = Parser("")
    without.add_argument("-n", "--n-timesteps")
    without.add_argument("-i", "--trained-agent")
    _, others = without.parse_known_args(argv)
    return shlex.join(["-n", str(n_timesteps), "-i", str(model), *others])


def main(argv: Sequence[str] | None = None) -> int:
    """
    Train, or resume a run.

    :param argv: arguments, those of the process by default
    :return: 0, 1 if training diverged or its model could not be saved, 130 if the user stopped it
    """
    with harmless_output():
        return _main(argv)


def _main(argv: Sequence[str] | None) -> int:
    parser = make_parser()
    args, given = parser.parse_args(argv), parser.parse_given(argv)
    start = time.monotonic()
    try:
        experiment = make_experiment(args) if args.resume is None else resume_experiment(args, given)
    except ValueError as error:
        parser.fail(error)
    if experiment is None:
        print(f"{args.resume} is finished: there is nothing to resume")
        return 0
    folder = experiment.folder
    if args.verbose > 0:
        verb = "Training" if args.resume is None else "Resuming"
        print(f"{verb} {args.algo} on {args.env}, seed {args.seed}, in {folder.path}", flush=True)
    try:
        outcome = train(experiment)
    except (SetupError, NotRestoredError) as error:
        parser.fail(error)
    except (TrainingError, NotSavedError, LockedError) as error:
        print(error, file=sys.stderr)
        if isinstance(error, TrainingError):
            print(f"The traceback is in {folder.error}", file=sys.stderr)
        if stored_steps(folder.checkpoint_folder):
            print(f"To continue from the newest checkpoint:\n  {folder.command_to_resume}", file=sys.stderr)
        return 1
    except NonFiniteError as error:
        print(f"{error}\nWhat was saved before stays in {folder.path}", file=sys.stderr)
        _say_how_to_go_back(folder)
        return 1
    except KeyboardInterrupt:
        print(f"Stopped without saving; what was saved before stays in {folder.path}", file=sys.stderr)
        return 130
    if args.verbose > 0:
        print(f"Saved {folder.model} after {timedelta(seconds=round(time.monotonic() - start))}")
    if outcome.interrupted:
        _say_how_to_go_on(argv, args, experiment, outcome)
        return 130
    if args.verbose > 0:
        packages = f" --gym-packages {shlex.join(args.gym_packages)}" if args.gym_packages else ""
        print(f"To watch it: python enjoy.py {shlex.quote(str(folder.path))}{packages}")
    return 0


def _say_how_to_go_back(folder: RunFolder) -> None:
    if steps := stored_steps(folder.checkpoint_folder):
        print(
            f"To go back to a step before ({', '.join(map(str, steps))}), with other hyperparameters for instance:\n"
            f"  {folder.command_to_resume} --from {steps[-1]} -params learning_rate:1.0e-4",
            file=sys.stderr,
        )


def _say_how_to_go_on(
    argv: Sequence[str] | None, args: argparse.Namespace, experiment: Experiment, outcome: Outcome
) -> None:
    steps, total = outcome.model.num_timesteps, experiment.hyperparams.n_timesteps
    folder = experiment.folder
    if outcome.checkpoint is not None:
        print(f"Stopped at step {steps:,} of {total:,}. To go on from step {outcome.checkpoint:,}:")
        print(f"  {folder.command_to_resume}")
    else:
        experience = "with" if args.save_replay_buffer else "without (--save-replay-buffer keeps it)"
        print(f"Stopped at step {steps:,} of {total:,}. To go on in a new run, {experience} the replay buffer:")
        print(f"  python train.py {_command_to_go_on(argv, total - steps, folder.model)}")


if __name__ == "__main__":
    sys.exit(main())
