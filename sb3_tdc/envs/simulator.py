"""What a simulator's file declares, so that its environments are made like all others."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.vec_env import VecEnv


def _register_nothing() -> None:
    pass


def _make(spec: EnvSpec, env_kwargs: dict[str, Any]) -> gym.Env:
    return spec.make(**env_kwargs)


@dataclass(frozen=True)
class Simulator:
    """
    How the environments of one simulator are registered and made.

    :param provides: whether an environment id is one of its own
    :param register: registers its environments; raises ``ValueError``, with the install command, if it is not installed
    :param make: makes one environment, given its registered spec and the constructor's arguments
    :param make_vec: of a simulator that makes all environments of a process at once, and once only: takes the id, the
        number of environments, the seed and the arguments
    """

    provides: Callable[[str], bool]
    register: Callable[[], None] = _register_nothing
    make: Callable[[EnvSpec, dict[str, Any]], gym.Env] = _make
    make_vec: Callable[[str, int, int, dict[str, Any]], VecEnv] | None = None


# All that is registered already, or by the package that the user names
GYMNASIUM = Simulator(provides=lambda env_id: True)
