"""
Isaac Lab's tasks (``Isaac-…-v0``): starts the application, imports the tasks, and uses the ``Sb3VecEnvWrapper``.

Written for the three published interfaces of that wrapper: with ``fast_variant`` (Isaac Lab 2.3), then with
``action_low`` and ``action_high``, then with ``action_bounds`` (September 2026). Their differences are recognised by
their behaviour, not by a version, and corrected. Tested with a stand-in for each, not with Isaac Sim itself.
"""

import importlib.util
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_tdc.envs.simulator import Simulator

_INSTALL = "https://isaac-sim.github.io/IsaacLab/main/source/setup/installation"


class IsaacVecEnv(VecEnvWrapper):
    """
    A wrapper around Isaac Lab's ``VecEnv`` that provides what SB3's off-policy algorithms require.

    - Unbounded actions get the bounds [-1, 1]. Isaac Lab gave them [-100, 100], to which tanh is scaled (issue 5080).
    - The last observation of an episode is the one before the reset. Where Isaac Lab gives the one after the reset
      instead, a time-out counts as the end of the task: there is nothing to bootstrap from.
    - There is one simulation for all environments: attributes cannot be set, and no single environment is wrapped.

    :param env: a ``Sb3VecEnvWrapper`` with any of the three interfaces
    """

    def __init__(self, env: VecEnv):
        space: Any = env.unwrapped.single_action_space  # type: ignore[attr-defined]  # of the task, not of the wrapper
        is_unbounded = isinstance(space, spaces.Box) and not space.is_bounded("both")
        action_space = spaces.Box(-1.0, 1.0, space.shape, np.float32) if is_unbounded else env.action_space
        super().__init__(env, action_space=action_space)
        self.has_last_observations = True

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, dones, infos = self.venv.step_wait()
        for i in map(int, np.flatnonzero(dones)):
            if _is_same(infos[i]["terminal_observation"], observations, i):
                self._end_without_last_observation(infos[i])
        return observations, rewards, dones, infos

    def _end_without_last_observation(self, info: dict[str, Any]) -> None:
        info["TimeLimit.truncated"] = False
        if self.has_last_observations:
            self.has_last_observations = False
            warnings.warn(
                "This version of Isaac Lab gives no last observation of an episode (compute_final_obs): "
                "time-outs count as the end of the task, and values are not bootstrapped through them",
                stacklevel=2,
            )

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError(f"Isaac Lab cannot set attributes of its environments ({attr_name})")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def render(self, mode: str | None = None) -> np.ndarray | None:
        frame: Any = self.venv.env_method("render")
        return frame


def _is_same(last: Any, observations: Any, i: int) -> bool:
    if isinstance(last, dict):
        return all(_is_same(last[key], observations[key], i) for key in last)
    return bool(np.array_equal(last, observations[i], equal_nan=True))


@cache  # a process can start it only once
def start() -> None:
    """
    Start Isaac Lab's application, without which no task can be imported.

    :raises ValueError: if Isaac Lab is not installed, with the address of the installation guide
    """
    with _requiring_isaac_lab(), _without_arguments():
        if not _is_installed():
            raise ModuleNotFoundError(name="isaaclab_tasks")
        importlib.import_module("isaaclab.app").AppLauncher(headless=True)


def register() -> None:
    """
    Register Isaac Lab's own tasks.

    :raises ValueError: if Isaac Lab is not installed, with the address of the installation guide
    """
    with _requiring_isaac_lab():
        importlib.import_module("isaaclab_tasks")


@contextmanager
def _requiring_isaac_lab() -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        raise ValueError(f"Isaac Lab's environments need Isaac Lab and Isaac Sim ({error.name}): {_INSTALL}") from error


def _is_installed() -> bool:
    return importlib.util.find_spec("isaaclab_tasks") is not None


@contextmanager
def _without_arguments() -> Iterator[None]:
    """Hide the command-line arguments of this process, which the application would read as its own."""
    arguments, sys.argv = sys.argv, sys.argv[:1]
    try:
        yield
    finally:
        sys.argv = arguments


def make_vec(env_id: str, n_envs: int, seed: int, env_kwargs: dict[str, Any]) -> VecEnv:
    """
    Make all environments in one simulation, in which they are stepped together.

    :param env_kwargs: override the task's configuration, with dots for nested settings (``sim.dt``); only ``device``
        (of the simulation) and ``render_mode`` are not part of the configuration
    :raises ValueError: if the configuration has no such setting
    """
    settings = {"device": "cuda:0", "render_mode": None, **env_kwargs}
    parse = importlib.import_module("isaaclab_tasks.utils").parse_env_cfg
    config = parse(env_id, device=settings.pop("device"), num_envs=n_envs)
    config.seed = seed
    if hasattr(config, "compute_final_obs"):
        config.compute_final_obs = True
    render_mode = settings.pop("render_mode")
    for name, value in settings.items():
        _set(config, name, value, env_id)
    wrapper = importlib.import_module("isaaclab_rl.sb3").Sb3VecEnvWrapper
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*unbounded action space")  # IsaacVecEnv bounds it
        return IsaacVecEnv(wrapper(gym.make(env_id, cfg=config, render_mode=render_mode)))


def _set(config: Any, name: str, value: Any, env_id: str) -> None:
    *path, last = name.split(".")
    for part in path:
        config = getattr(config, part, None)
    if not hasattr(config, last):
        raise ValueError(f"the configuration of {env_id} has no {name}")
    setattr(config, last, value)


ISAAC = Simulator(lambda env_id: env_id.startswith("Isaac-"), start, register, make_vec=make_vec)
