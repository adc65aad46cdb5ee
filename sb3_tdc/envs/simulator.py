"""The declaration of a simulator, by which its environments are made like all others."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.vec_env import VecEnv


def _do_nothing() -> None:
    pass


def _make(spec: EnvSpec, env_kwargs: dict[str, Any]) -> gym.Env:
    return spec.make(**env_kwargs)


@dataclass(frozen=True)
class Simulator:
    """
    The functions that start one simulator, and register and make its environments.

    :param provides: returns whether an environment id belongs to the simulator
    :param start: starts its application, unless it runs already: custom environments are imported after that
    :param register: registers its environments; raises ``ValueError``, as ``start``, with the install command, if it is
        not installed
    :param make: makes one environment, given its registered spec and the constructor's arguments
    :param make_vec: only for a simulator that makes all environments of a process at once, and only once; takes the id,
        the number of environments, the seed and the constructor's arguments
    """

    provides: Callable[[str], bool]
    start: Callable[[], None] = _do_nothing
    register: Callable[[], None] = _do_nothing
    make: Callable[[EnvSpec, dict[str, Any]], gym.Env] = _make
    make_vec: Callable[[str, int, int, dict[str, Any]], VecEnv] | None = None


# All environments that are registered already, or by a package that the user names
GYMNASIUM = Simulator(provides=lambda env_id: True)
