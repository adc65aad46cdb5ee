"""
``python -m experiments.test_returns LOGS``: 100 mean-action episodes of every finished run (Fig. 4), kept beside it.

Episode i begins with the evaluation seed 10,000 + i in every run, so that algorithms meet the same initial states.
"""

import hashlib
import importlib
import os
import sys
import zipfile
import zlib
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from experiments.results import Run, find_runs
from experiments.suites import PACKAGES
from sb3_tdc.arguments import Parser, add_package_argument
from sb3_tdc.experiment import ALGORITHMS, check_env_id, make_envs
from sb3_tdc.hyperparams import parse
from sb3_tdc.safe_load import load_safely

FILE = "test_returns.npz"
EPISODES = 100
FIRST_SEED = 10_000


def play_episodes(model: BaseAlgorithm, env: VecEnv, episodes: int, first_seed: int = FIRST_SEED) -> np.ndarray:
    """
    :param env: one environment, under a ``Monitor``
    :return: (episodes,), the return of the mean action from the initial state of each seed
    """
    returns = np.empty(episodes)
    for episode in range(episodes):
        env.seed(first_seed + episode)
        observation: Any = env.reset()
        done = False
        while not done:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, dones, infos = env.step(action)
            done = dones[0]
        returns[episode] = infos[0]["episode"]["r"]
    return returns


def checksum(run: Run) -> str:
    """:return: SHA-256 of the model and of its normalisation: what the returns depend on"""
    digest = hashlib.sha256(run.folder.model.read_bytes())
    normalization = run.folder.normalization(run.folder.model)
    if normalization.is_file():
        digest.update(normalization.read_bytes())
    return digest.hexdigest()


def read_test_returns(run: Run) -> np.ndarray | None:
    """:return: (episodes,), or None if the model as it is now has not been tested"""
    path = run.folder.path / FILE
    if not path.is_file():
        return None
    try:
        with np.load(path) as saved:
            # Published results have no model that could have changed
            is_of_model = not run.folder.model.is_file() or str(saved["checksum"]) == checksum(run)
            return saved["returns"] if is_of_model else None
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):  # played again
        return None


def measure_run(run: Run, episodes: int = EPISODES, packages: Sequence[str] = ()) -> np.ndarray:
    """
    Play the episodes and keep their returns, unless they are kept already.

    :param packages: those that a run may import, to register its environment
    :return: (episodes,)
    :raises ValueError: if the run cannot be loaded
    """
    kept = read_test_returns(run)
    if kept is not None and len(kept) >= episodes:
        return kept[:episodes]
    before = checksum(run)
    args = run.folder.args
    for package in args.get("gym_packages") or []:
        if package not in (*packages, *PACKAGES.values()):
            raise ValueError(f"it asks for the package {package}: if you know it, add --gym-packages {package}")
        importlib.import_module(package)
    check_env_id(run.env_id)
    hyperparams = parse(run.folder.config, ALGORITHMS[run.algo], str(run.folder.path))
    normalization = run.folder.normalization(run.folder.model) if hyperparams.normalize is not None else None
    env = make_envs(
        run.env_id,
        hyperparams,
        FIRST_SEED,
        n_envs=1,
        env_kwargs=args["eval_env_kwargs"] or args["env_kwargs"],
        normalization=normalization,
        training=False,
    )
    with closing(env):
        model = load_safely(run.folder.model, device="cpu", algorithm=ALGORITHMS[run.algo], buffer_size=1)
        returns = play_episodes(model, env, episodes)
    part = run.folder.path / f".{FILE}.part.npz"
    np.savez(part, returns=returns, checksum=before, first_seed=FIRST_SEED)
    os.replace(part, run.folder.path / FILE)
    return returns


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: arguments, those of the process by default
    :return: 0, or 1 if a run could not be tested
    """
    parser = Parser("Play test episodes with every finished run; what has been played is not played again.")
    parser.add_argument("logs", type=Path, help="folder of runs")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="episodes for each run")
    add_package_argument(parser)
    args = parser.parse_args(argv)
    if args.episodes < 1:
        parser.fail(ValueError(f"--episodes must be at least 1, got {args.episodes}"))
    try:
        runs, unreadable = find_runs(args.logs)
    except ValueError as error:
        parser.fail(error)
    failed = list(unreadable)
    for run in runs:
        if not run.is_finished:
            print(f"{run.folder.path}: left out, at step {run.steps:,} of {run.n_timesteps:,}")
            continue
        try:
            returns = measure_run(run, args.episodes, args.gym_packages)
        except Exception as error:  # one run must not stop the others
            failed.append(f"{run.folder.path}: {type(error).__name__}: {' '.join(str(error).split())}")
            continue
        print(f"{run.folder.path}: {returns.mean():.1f} ± {returns.std():.1f} ({len(returns)} episodes)", flush=True)
    for sentence in failed:
        print(f"Failed: {sentence}", file=sys.stderr)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
