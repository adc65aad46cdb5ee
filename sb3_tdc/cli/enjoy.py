"""``sb3-tdc enjoy logs/tdc/Walker2d-v4_1``: watch, record or explain a trained agent."""

import argparse
import sys
from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.error import DependencyNotInstalled
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_tdc.ablations import know_ablations
from sb3_tdc.advb.policies import AdvisedPolicy
from sb3_tdc.algorithms import ALGORITHMS
from sb3_tdc.cli.arguments import Parser, add_settings, add_trust, warn_about_trust
from sb3_tdc.common.files import check_writable
from sb3_tdc.common.threads import set_threads
from sb3_tdc.common.words import count
from sb3_tdc.critics.episodes import record_episodes
from sb3_tdc.critics.figures import write_explanation
from sb3_tdc.critics.returns import steps_until_negligible
from sb3_tdc.envs.checked import EnvironmentFaultError
from sb3_tdc.envs.registry import import_packages, is_of_mujoco, split_env_id
from sb3_tdc.envs.rendering import (
    VIDEO_SUFFIXES,
    VideoWriter,
    choose_gl_backend,
    display_works,
    follow_agent,
    render_modes,
)
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.runs.settings import MAX_SEED, RunSettings, check_settings
from sb3_tdc.runs.trained import TrainedModel, open_run, open_zip
from sb3_tdc.tdc import TDC

# What users of RL Zoo type by habit
_ZOO_FLAGS = {
    "--deterministic": "the mean action is the default here; --stochastic samples",
    "--n-envs": "one environment is played; --n-episodes says how often",
    "--norm-reward": "returns are those of the environment, never normalised",
    "--reward-log": "every return is printed; those of training are in monitor.csv in the run folder",
    "--custom-objects": "objects that cannot be loaded here are refused by name; --trust loads as SB3 does",
    **dict.fromkeys(("-P", "--progress"), "every episode is printed as it ends"),
    "--render": "there is a window where there is a display; --record FILE.mp4 writes a video",
}


# Of a run's models
_CHOICES = ("load_best", "load_checkpoint", "load_last_checkpoint")


def make_parser() -> Parser:
    """Return RL Zoo's flags, and the folder of a run instead of ``--algo``, ``--env`` and ``--exp-id``."""
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
    add("--board", action="store_true", help="actions of the advisory board (AdvB) instead of those of the actor alone")

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


def find_run(args: argparse.Namespace) -> RunFolder:
    """
    Find the folder of the run that the arguments name.

    :raises ValueError: if there is no such run
    """
    if args.run is not None:
        return RunFolder.open(args.run)
    return RunFolder.find(args.log_folder, args.algo, args.env, args.exp_id)


def find_model(args: argparse.Namespace, run: RunFolder) -> Path:
    """
    Find the zip that the arguments name.

    :return: the zip that the arguments name
    :raises ValueError: if there is none, with what there is
    """
    checkpoints = run.checkpoints()
    if args.load_best:
        path = run.best_model
    elif args.load_checkpoint is not None or args.load_last_checkpoint:
        steps = args.load_checkpoint if args.load_checkpoint is not None else max(checkpoints, default=-1)
        if steps not in checkpoints:
            known = f"there are those of steps {', '.join(map(str, checkpoints))}" if checkpoints else "it has none"
            raise ValueError(
                f"{run.path} has no saved model of step {steps}; {known} (sb3-tdc train --save-freq makes them)"
            )
        path = checkpoints[steps]
    else:
        path = run.model
    if not path.is_file():
        others = [p.name for p in (run.model, run.best_model, *checkpoints.values()) if p.is_file()]
        raise ValueError(f"{path} does not exist; in its folder are: {', '.join(others) or 'no models'}")
    return path


def find_trained(args: argparse.Namespace, given: Collection[str]) -> TrainedModel:
    """
    Return the model that the arguments name; for a zip outside a run, the algorithm and the environment are theirs.

    :param given: names of the arguments that are not defaults
    :raises ValueError: if there is none, or the arguments contradict each other
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
    run = find_run(args)
    return open_run(run, find_model(args, run), args.gym_packages, args.trust)


def _open_file(args: argparse.Namespace, given: Collection[str]) -> TrainedModel:
    try:
        run = RunFolder.open(args.run.parent)  # it tells what its models were trained with
    except ValueError:
        if "env" not in given:
            raise ValueError(
                f"{args.run} is not in the folder of a run: say with --env what it was trained on"
            ) from None
        import_packages(args.gym_packages)
        return open_zip(args.run, args.algo, args.env, args.trust)
    return open_run(run, args.run, args.gym_packages, args.trust)


def play(model: BaseAlgorithm, env: VecEnv, args: argparse.Namespace, video: VideoWriter | None) -> list[float]:
    """
    Play episodes in one environment.

    :return: the return of each finished episode, as the environment gave it (not normalised)
    """
    returns: list[float] = []
    observation: Any = env.reset()
    steps = 0
    try:
        while len(returns) < args.n_episodes and steps != args.n_timesteps:
            if video is not None:
                frame = env.render()
                assert frame is not None
                video.add(frame)
            action, _ = model.predict(observation, deterministic=not args.stochastic)
            observation, _, dones, infos = env.step(action)
            steps += 1
            if dones[0]:
                episode = infos[0]["episode"]
                returns.append(float(episode["r"]))
                if args.verbose > 0:
                    print(
                        f"Episode {len(returns):>3}: return {episode['r']:10.2f}, {count(episode['l'], 'step')}",
                        flush=True,
                    )
    except KeyboardInterrupt:
        print("Stopped.")
    return returns


def _rendering(args: argparse.Namespace, env_id: str, env_kwargs: dict[str, Any]) -> dict[str, Any]:
    """
    Decide what is drawn and say how; MuJoCo's backend is chosen before it is imported.

    :param env_kwargs: what the environment is made with anyway; a ``render_mode`` there is one that it needs
    :return: its ``render_mode``, if it is to have one
    :raises ValueError: if it cannot be recorded
    """
    needed, modes = env_kwargs.get("render_mode"), render_modes(env_id)
    wanted = None if args.no_render and args.record is None else "human" if args.record is None else "rgb_array"
    why = f"it is made with render_mode {needed}"
    possible = {needed} if needed is not None else modes | ({"human"} if "rgb_array" in modes else set())
    if needed is None:
        why = f"it draws {', '.join(sorted(modes)) or 'nothing'}"
    if wanted == "rgb_array" and wanted not in possible:
        raise ValueError(f"{env_id} cannot be recorded: {why}")
    if wanted == "human" and wanted not in possible:
        print(f"No window: {why}" + (". To see the agent: --record FILE.mp4" if "rgb_array" in possible else ""))
        wanted = None
    if wanted == "human" and not display_works():
        print("There is no display: no window. To see the agent: --record FILE.mp4")
        wanted = None
    drawn = needed or wanted
    if drawn is not None and is_of_mujoco(env_id):
        print(choose_gl_backend(drawn == "human"))
    return {} if needed is not None or drawn is None else {"render_mode": drawn}


def check_explainable(args: argparse.Namespace, trained: TrainedModel) -> None:
    """
    Check the arguments of ``--explain``.

    :raises ValueError: if there is nothing to explain, or an argument has no meaning with ``--explain``
    """
    if not issubclass(ALGORITHMS[trained.algo], TDC):
        known = " or ".join(name for name, algorithm in ALGORITHMS.items() if issubclass(algorithm, TDC))
        raise ValueError(f"--explain needs a model of {known}: the critics of {trained.algo} predict no distribution")
    for name in ("record", "stochastic", "board"):
        if getattr(args, name):
            raise ValueError(f"--explain plays the actor's mean action, without a picture: leave out --{name}")
    if args.n_timesteps != -1:
        raise ValueError("--explain needs whole episodes: leave out -n")


def extend_time_limit(trained: TrainedModel, env_kwargs: dict[str, Any]) -> tuple[int | None, dict[str, Any]]:
    """
    A time limit ends an episode, but not the return that the critics predict: play on until the discount has faded.

    :return: the environment's own limit, None for none, and the arguments with the later one
    """
    own = gym.spec(trained.env_id).max_episode_steps
    limit = {**trained.hyperparams.env_kwargs, **env_kwargs}.get("max_episode_steps", own)
    gamma = trained.hyperparams.model.get("gamma", 0.99)
    if limit is None or gamma >= 1:
        return limit, env_kwargs
    return limit, {**env_kwargs, "max_episode_steps": limit + steps_until_negligible(gamma)}


def explain(model: TDC, env: VecEnv, trained: TrainedModel, n_episodes: int, limit: int | None) -> None:
    """Play episodes, and draw what the critics predict next to the model."""
    normalization = unwrap_vec_normalize(env)
    if normalization is not None:  # the critics know no other rewards
        normalization.norm_reward = (trained.hyperparams.normalize or {}).get("norm_reward", True)
    episodes = record_episodes(model, env, n_episodes, limit)
    unit = "normalised rewards, " if normalization is not None and normalization.norm_reward else ""
    title = (
        f"{type(model).__name__} on {trained.env_id}, {model.num_timesteps:,} steps of training ({trained.path.name}), "
        f"{unit}λ = {model.scheduled('lam'):g}, γ = {model.gamma:g}"
    )
    write_explanation(model, episodes, _explanation(trained), title)


def _explanation(trained: TrainedModel) -> Path:
    """Return the files of ``--explain``, without their endings."""
    return trained.path.with_name(f"{trained.path.stem}_critics")


def _check_outputs(args: argparse.Namespace, trained: TrainedModel) -> None:
    """
    Check that every output can be written.

    :raises ValueError: if an output cannot be written, before anything is played
    """
    if args.explain:
        check_writable("--explain:", Path(f"{_explanation(trained)}.png"))
    if args.record is not None:
        if args.record.suffix not in VIDEO_SUFFIXES:
            raise ValueError(f"--record {args.record}: the name must end in one of {', '.join(VIDEO_SUFFIXES)}")
        check_writable("--record", args.record)


def _choose_who_acts(model: BaseAlgorithm, args: argparse.Namespace) -> AbstractContextManager[None]:
    """
    Let the board or the actor alone act.

    :return: a context in which the board acts (``--board``), or the actor alone
    :raises ValueError: if there is no board, or it has no members
    """
    if not isinstance(model.policy, AdvisedPolicy):
        if args.board:
            raise ValueError("--board needs a model of advb_td3, advb_sac or advb_tdc: this one has no board")
        return nullcontext()
    if args.board and (args.stochastic or len(model.policy.board) == 0):
        why = (
            "takes mean actions: leave out --stochastic" if args.stochastic else "needs members: this one has none yet"
        )
        raise ValueError(f"--board {why}")
    return nullcontext() if args.board else model.policy.actor_alone()


def _check_arguments(args: argparse.Namespace) -> None:
    """:raises ValueError: for a number that is not allowed, or a device that is not there"""
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
        check_explainable(args, trained)
        limit, env_kwargs = extend_time_limit(trained, env_kwargs)
    else:
        made_with = {**gym.spec(trained.env_id).kwargs, **trained.hyperparams.env_kwargs, **env_kwargs}
        env_kwargs.update(_rendering(args, trained.env_id, made_with))

    with ExitStack() as stack:
        env = trained.make_env(args.seed, **env_kwargs)
        stack.callback(env.close)
        for unwrapped in env.get_attr("unwrapped"):
            follow_agent(unwrapped)
        model = trained.load(env, args.device)
        stack.enter_context(_choose_who_acts(model, args))
        env.seed(args.seed)  # loading has seeded it as for training
        print(f"{trained.path}: {trained.algo} on {trained.env_id}, trained for {count(model.num_timesteps, 'step')}")
        if args.explain:
            assert isinstance(model, TDC)
            explain(model, env, trained, args.n_episodes, limit)
            return 0
        returns = play(model, env, args, _open_video(args, env, stack))
    if args.record is not None:
        print(f"Wrote {args.record}")
    if returns:
        print(
            f"Return: {np.mean(returns):.2f} ± {np.std(returns):.2f} (mean ± std of {count(len(returns), 'episode')})"
        )
    return 0


def _open_video(args: argparse.Namespace, env: VecEnv, stack: ExitStack) -> VideoWriter | None:
    if args.record is None:
        return None
    fps = env.metadata.get("render_fps", 30)
    assert isinstance(fps, (int, float))
    return stack.enter_context(VideoWriter(args.record, fps))


def main(argv: Sequence[str] | None = None) -> int:
    """
    Watch, record or explain a trained agent.

    :param argv: arguments, those of the process by default
    :return: 0, or 1 if the environment failed
    """
    know_ablations()
    parser = make_parser()
    args, given = parser.parse_args(argv), parser.parse_given(argv)
    try:
        return _play_or_explain(args, given)
    except (ValueError, ImportError, DependencyNotInstalled) as error:
        parser.fail(error)
    except EnvironmentFaultError as error:
        print(f"{parser.prog}: error: the environment failed: {error}", file=sys.stderr)
        return 1
