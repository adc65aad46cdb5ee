"""Test returns (Fig. 4): 100 mean-action episodes with the last model of every finished run, stored in its folder.

Episode i begins with the evaluation seed 10,000 + i in every run, so that all algorithms meet the same initial states.
"""

import hashlib
from collections.abc import Sequence
from contextlib import closing
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdc.common.arrays import read_arrays
from sb3_tdc.common.files import check_writable, write_atomically
from sb3_tdc.common.playing import play_episodes
from sb3_tdc.experiments.results import Run
from sb3_tdc.runs.trained import open_run

EPISODES = 100
FIRST_SEED = 10_000  # seeds the environment in the first episode


def play_final_episodes(model: BaseAlgorithm, env: VecEnv, episodes: int, first_seed: int = FIRST_SEED) -> np.ndarray:
    """
    Play episodes of the mean action, each from the initial state of its own seed.

    :param env: one environment, under a ``Monitor``
    :return: (episodes,), the return of the mean action from the initial state of each seed
    """
    returns = np.empty(episodes)
    for episode in range(episodes):
        env.seed(first_seed + episode)
        returns[episode] = next(play_episodes(model, env)).total
    return returns


def checksum(run: Run) -> str:
    """Return the SHA-256 of the model and its normalisation, the files that the returns depend on."""
    digest = hashlib.sha256(run.folder.model.read_bytes())
    normalization = run.folder.normalization(run.folder.model)
    if normalization.is_file():
        digest.update(normalization.read_bytes())
    return digest.hexdigest()


def read_test_returns(run: Run) -> np.ndarray | None:
    """Return the stored test returns, (episodes,), or None if the current model has not been tested."""
    path = run.folder.test_returns
    if not path.is_file():
        return None
    try:
        tested, returns = read_arrays(path, "checksum", "returns")
    except ValueError:  # a damaged file: the episodes are to be played again
        return None
    # Published results have no model that could have changed
    return returns if not run.folder.model.is_file() or str(tested) == checksum(run) else None


def measure_run(run: Run, episodes: int = EPISODES, packages: Sequence[str] = (), trust: bool = False) -> np.ndarray:
    """
    Play the test episodes and store their returns, unless these are stored already.

    :param packages: packages that a run may import to register its environment
    :param trust: whether the run's files may run code
    :return: the returns, (episodes,)
    :raises ValueError: if the run cannot be loaded, or its returns cannot be written
    """
    kept = read_test_returns(run)
    if kept is not None and len(kept) >= episodes:
        return kept[:episodes]
    path = run.folder.test_returns
    check_writable("Test returns:", path)
    before = checksum(run)
    trained = open_run(run.folder, run.folder.model, packages, trust)
    env = trained.make_env(FIRST_SEED, trained.eval_env_kwargs or trained.env_kwargs)
    with closing(env):
        returns = play_final_episodes(trained.load(env, "cpu"), env, episodes)
    contents: dict[str, Any] = {"returns": returns, "checksum": before, "first_seed": FIRST_SEED}
    write_atomically(lambda part: np.savez(part, **contents), path)
    return returns
