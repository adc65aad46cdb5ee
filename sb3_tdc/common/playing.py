"""Steps and episodes of a model that is played in an environment."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv


class Step(NamedTuple):
    """
    One step of a model in an environment.

    :param observation: the observation that the model acted on, with a batch axis of 1
    :param action: (A,)
    """

    observation: Any
    action: np.ndarray
    reward: float
    done: bool
    info: dict[str, Any]


class PlayedEpisode(NamedTuple):
    """
    A finished episode.

    :param total: the return: the sum of the environment's own rewards, not normalised
    :param length: number of steps
    """

    total: float
    length: int


def play_steps(model: BaseAlgorithm, env: VecEnv, deterministic: bool = True) -> Iterator[Step]:
    """
    Yield the steps of one episode after another, without end.

    :param env: a single environment, which is reset first
    """
    observation: Any = env.reset()
    while True:
        acted_on = observation
        action, _ = model.predict(acted_on, deterministic=deterministic)
        observation, rewards, dones, infos = env.step(action)
        yield Step(acted_on, action[0], float(rewards[0]), bool(dones[0]), infos[0])


def play_episodes(
    model: BaseAlgorithm, env: VecEnv, deterministic: bool = True, n_timesteps: int | None = None
) -> Iterator[PlayedEpisode]:
    """
    Yield every finished episode.

    :param env: a single environment, wrapped in a ``Monitor``
    :param n_timesteps: number of steps to stop after; None to play without end
    """
    if n_timesteps is not None and n_timesteps < 1:
        return
    for n, step in enumerate(play_steps(model, env, deterministic), start=1):
        if step.done:
            yield PlayedEpisode(float(step.info["episode"]["r"]), int(step.info["episode"]["l"]))
        if n == n_timesteps:
            return
