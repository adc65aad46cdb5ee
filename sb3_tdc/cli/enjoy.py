"""``sb3-tdc enjoy logs/tdc/Walker2d-v4_1``: watch, record or explain a trained agent."""

import argparse
import sys
from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from itertools import islice
from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium.error import DependencyNotInstalled
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdc.advb.policies import AdvisedPolicy
from sb3_tdc.cli.arguments import Parser, add_settings, add_trust, warn_about_trust
from sb3_tdc.common.files import check_writable
from sb3_tdc.common.playing import play_episodes
from sb3_tdc.common.threads import set_threads
from sb3_tdc.common.words import count
from sb3_tdc.envs.checked import EnvironmentFaultError
from sb3_tdc.envs.registry import split_env_id
from sb3_tdc.envs.rendering import VIDEO_SUFFIXES, Filmed, VideoWriter, choose_render_mode, follow_agent
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS
from sb3_tdc.runs.explaining import explain, explanation_path, extend_time_limit
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.runs.settings import MAX_SEED, RunSettings, check_settings
from sb3_tdc.runs.trained import TrainedModel, find_model, open_run, open_zip
from sb3_tdc.tdc import TDC

# Flags that users of RL Zoo type by habit, with what to know about them here
_ZOO_FLAGS = {
    "--deterministic": "the mean action is the default here; --stochastic samples",
    "--n-envs": "one environment is played; --n-episodes says how often",
    "--norm-reward": "returns are those of the environment, never normalised",
    "--reward-log": "every return is printed; those of training are in monitor.csv in the run folder",
    "--custom-objects": "objects that cannot be loaded here are refused by name; --trust loads as SB3 does",
    **dict.fromkeys(("-P", "--progress"), "every episode is printed as it ends"),
    "--render": "there is a window where there is a display; --record FILE.mp4 writes a video",
}


# Flags that choose one of a run's models
_CHOICES = ("load_best", "load_checkpoint", "load_last_checkpoint")


def make_parser() -> Parser:
    """Return a parser of RL Zoo's flags; a run folder may replace ``--algo``, ``--env`` and ``--exp-id``."""
    parser = Parser(
        "enjoy",
        "Watch a trained agent: in a window where there is a display, with --record where there is none.",
        _ZOO_FLAGS,
    )
    group = parser.add_argument_group("model")
    add = group.add_argument
    add("run", nargs="?", type=Path, help="folder of a run, or a zip (else: the run of --algo, --env and --exp-id)")
    add_settings(group, ("algo", "env", "log_folder", "gym_packages"))
    add("--exp-id", type=int, default=0, metavar="N", help="number of the run (0: the latest)")
    which = group.add_mutually_exclusive_group()
    which.add_argument("--load-best", action="store_true", help="load the best model instead of the last")
    which.add_argument("--load-checkpoint", type=int, metavar="STEPS", help="load the model saved at this step")
    which.add_argument("--load-last-checkpoint", action="store_true", help="load the last model of --save-freq")
    add_trust(group)

    group = parser.add_argument_group("episodes")
    add = group.add_argument
    add("--n-episodes", type=int, default=5, metavar="N", help="episodes to play")
    add(
        "-n",
        "--n-timesteps",
        type=int,
        default=-1,
        metavar="STEPS",
        help="stop after this many steps (default -1: no limit)",
    )
    add("--seed", type=int, default=0, help="seed of the environment")
    add_settings(group, ["env_kwargs"])
    add(
        "--stochastic",
        action="store_true",
        help="sample actions instead of taking the mean (SAC, MEOW; TDC always takes the mean)",
    )
    add("--actor-alone", action="store_true", help="play the actor of an AdvB model without its advisory board")

    group = parser.add_argument_group("output")
    add = group.add_argument
    add("--record", type=Path, metavar="FILE.mp4", help="write a video")
    add("--no-render", action="store_true", help="open no window, print returns only")
    add(
        "--explain",
        action="store_true",
        help="draw the returns that the critics predict against those that follow, into a file next to the model",
    )
    add("--verbose", type=int, default=1, metavar="LEVEL", help="0: only the result, 1: every episode")

    add_settings(parser.add_argument_group("process"), ("num_threads", "device"))
    return parser


def find_trained(args: argparse.Namespace, given: Collection[str]) -> TrainedModel:
    """
    Return the model that the arguments name. For a zip outside a run, they also name its algorithm and environment.

    :param given: names of the arguments that are on the command line
    :raises ValueError: if there is no such model, or the arguments contradict each other
    """
    if args.run is None:
        return _open_run(args)
    for name in ("exp_id", "log_folder", *(_CHOICES if args.run.is_file() else ())):
        if name in given:
            raise ValueError(f"--{name.replace('_', '-')} chooses a model, and so does {args.run}: leave out one")
    trained = _open_file(args, given) if args.run.is_file() else _open_run(args)
    for name, found in (("algo", trained.algo), ("env", trained.env_id)):
        if name in given and getattr(args, name) != found:
            raise ValueError(f"--{name} {getattr(args, name)} contradicts {args.run}: it was trained with {found}")
    return trained


def _open_run(args: argparse.Namespace) -> TrainedModel:
    if args.run is not None:
        run = RunFolder.open(args.run)
    else:
        run = RunFolder.find(args.log_folder, args.algo, args.env, args.exp_id)
    model = find_model(run, args.load_best, args.load_checkpoint, args.load_last_checkpoint)
    return open_run(run, model, args.gym_packages, args.trust)


def _open_file(args: argparse.Namespace, given: Collection[str]) -> TrainedModel:
    try:
        run = RunFolder.open(args.run.parent)  # the run folder knows the algorithm and the environment
    except ValueError:
        if "env" not in given:
            raise ValueError(
                f"{args.run} is not in the folder of a run: say with --env what it was trained on"
            ) from None
        return open_zip(args.run, args.algo, args.env, args.gym_packages, args.trust)
    return open_run(run, args.run, args.gym_packages, args.trust)


def _play(model: BaseAlgorithm, env: VecEnv, args: argparse.Namespace) -> list[float]:
    """Play episodes, print the return of each, and return them."""
    returns: list[float] = []
    try:
        steps = None if args.n_timesteps == -1 else args.n_timesteps
        episodes = play_episodes(model, env, not args.stochastic, steps)
        for number, episode in enumerate(islice(episodes, args.n_episodes), start=1):
            returns.append(episode.total)
            if args.verbose > 0:
                length = count(episode.length, "step")
                print(f"Episode {number:>3}: return {episode.total:10.2f}, {length}", flush=True)
    except KeyboardInterrupt:
        print("Stopped.")
    return returns


def _check_explainable(args: argparse.Namespace, trained: TrainedModel) -> None:
    """
    Check the arguments of ``--explain``.

    :raises ValueError: if the critics predict no distribution, or another argument has no meaning with ``--explain``
    """
    if not issubclass(KNOWN_ALGORITHMS[trained.algo], TDC):
        known = " or ".join(name for name, algorithm in KNOWN_ALGORITHMS.items() if issubclass(algorithm, TDC))
        raise ValueError(f"--explain needs a model of {known}: the critics of {trained.algo} predict no distribution")
    for name in ("record", "stochastic"):
        if getattr(args, name):
            raise ValueError(f"--explain plays the actor's mean action, without a picture: leave out --{name}")
    if args.n_timesteps != -1:
        raise ValueError("--explain needs whole episodes: leave out -n")


def _check_outputs(args: argparse.Namespace, trained: TrainedModel) -> None:
    """
    Check that every output file can be written, before anything is played.

    :raises ValueError: if a file cannot be written
    """
    if args.explain:
        check_writable("--explain:", Path(f"{explanation_path(trained)}.png"))
    if args.record is not None:
        if args.record.suffix not in VIDEO_SUFFIXES:
            raise ValueError(f"--record {args.record}: the name must end in one of {', '.join(VIDEO_SUFFIXES)}")
        check_writable("--record", args.record)


def _choose_who_acts(model: BaseAlgorithm, args: argparse.Namespace) -> AbstractContextManager[None]:
    """
    Choose whether the advisory board of a model takes part, as in ``predict``, or the actor acts alone.

    :return: a context in which the actor acts alone, if ``--actor-alone`` or ``--explain`` is given
    :raises ValueError: if ``--actor-alone`` is given for a model without a board
    """
    if isinstance(model.policy, AdvisedPolicy):
        return model.policy.actor_alone() if args.actor_alone or args.explain else nullcontext()
    if args.actor_alone:
        raise ValueError("--actor-alone is for models of advb_td3, advb_sac and advb_tdc: this one has no board")
    return nullcontext()


def _check_arguments(args: argparse.Namespace) -> None:
    """
    Check the numbers and the device among the arguments.

    :raises ValueError: if a number is not allowed, or there is no such device
    """
    check_settings(RunSettings(num_threads=args.num_threads, device=args.device))
    if not 0 <= args.seed <= MAX_SEED:
        raise ValueError(f"--seed must be 0 to {MAX_SEED}, got {args.seed}")
    if args.n_episodes < 1:
        raise ValueError(f"--n-episodes must be at least 1, got {args.n_episodes}")
    if args.n_timesteps < 1 and args.n_timesteps != -1:
        raise ValueError(f"-n must be at least 1 (or -1: no limit), got {args.n_timesteps}")


def _play_or_explain(args: argparse.Namespace, given: Collection[str]) -> int:
    args.env, args.gym_packages = split_env_id(args.env, args.gym_packages)
    warn_about_trust(args.trust)
    _check_arguments(args)
    set_threads(args.num_threads)
    trained = find_trained(args, given)
    set_random_seed(args.seed)
    env_kwargs = {**trained.env_kwargs, **args.env_kwargs}
    _check_outputs(args, trained)
    limit = None
    if args.explain:
        _check_explainable(args, trained)
        limit, env_kwargs = extend_time_limit(trained, env_kwargs)
    else:
        made_with = {**gym.spec(trained.env_id).kwargs, **trained.hyperparams.env_kwargs, **env_kwargs}
        mode, said = choose_render_mode(trained.env_id, made_with, args.record is not None, not args.no_render)
        env_kwargs.update(mode)
        for sentence in said:
            print(sentence)

    with ExitStack() as stack:
        env = trained.make_env(args.seed, env_kwargs)
        stack.callback(env.close)
        for unwrapped in env.get_attr("unwrapped"):
            follow_agent(unwrapped)
        model = trained.load(env, args.device)
        stack.enter_context(_choose_who_acts(model, args))
        env.seed(args.seed)  # loading the model has seeded it as for training
        print(f"{trained.path}: {trained.algo} on {trained.env_id}, trained for {count(model.num_timesteps, 'step')}")
        if args.explain:
            assert isinstance(model, TDC)
            explain(model, env, trained, args.n_episodes, limit)
            return 0
        returns = _play(model, _filmed(env, args, stack), args)
    if args.record is not None:
        print(f"Wrote {args.record}")
    if returns:
        print(
            f"Return: {np.mean(returns):.2f} ± {np.std(returns):.2f} (mean ± std of {count(len(returns), 'episode')})"
        )
    return 0


def _filmed(env: VecEnv, args: argparse.Namespace, stack: ExitStack) -> VecEnv:
    """Wrap an environment so that it writes the video of ``--record``, if that is given."""
    if args.record is None:
        return env
    (metadata,) = env.get_attr("metadata")  # of the environment: a wrapper of a VecEnv has its own
    return Filmed(env, stack.enter_context(VideoWriter(args.record, metadata.get("render_fps") or 30)))


def main(argv: Sequence[str] | None = None) -> int:
    """
    Watch, record or explain a trained agent.

    :param argv: arguments; by default, those of the process
    :return: 0, or 1 if the environment failed
    """
    parser = make_parser()
    args, given = parser.parse_args(argv), parser.parse_given(argv)
    try:
        return _play_or_explain(args, given)
    except (ValueError, ImportError, DependencyNotInstalled) as error:
        parser.fail(error)
    except EnvironmentFaultError as error:
        print(f"{parser.prog}: error: the environment failed: {error}", file=sys.stderr)
        return 1
