"""What a simulator's file declares, so that its environments are made like all others."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec


@dataclass(frozen=True)
class Simulator:
    """
    How the environments of one simulator are registered and made.

    :param provides: whether an environment id is one of its own
    :param register: registers its environments; raises ``ValueError``, with the install command, if it is not installed
    :param make: makes one environment, given its registered spec and the constructor's arguments
    """

    provides: Callable[[str], bool]
    register: Callable[[], None]
    make: Callable[[EnvSpec, dict[str, Any]], gym.Env]


# All that is registered already, or by the package that the user names
GYMNASIUM = Simulator(
    provides=lambda env_id: True, register=lambda: None, make=lambda spec, env_kwargs: spec.make(**env_kwargs)
)
