"""PyBullet's tasks (``HopperBulletEnv-v0``, …): registered on demand, without the simulator's own output."""

import ctypes
import importlib
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from sb3_tdc.envs.simulator import Simulator

_PACKAGE = "pybullet_envs_gymnasium"


def register() -> None:
    """
    Register the tasks.

    :raises ValueError: if PyBullet is not installed, with the command that installs it
    """
    try:
        with _quiet():
            importlib.import_module("pybullet")
            importlib.import_module(_PACKAGE)
    except ImportError as error:
        wheels = "" if sys.version_info < (3, 12) else " (PyBullet has wheels for Python 3.11 and older only)"
        raise ValueError(f'PyBullet\'s environments need: pip install "sb3-tdc[pybullet]"{wheels}') from error


def make(spec: EnvSpec, env_kwargs: dict[str, Any]) -> gym.Env:
    """Make an environment and load its world at once, by a reset: exact resume restores into an existing world."""
    with _quiet():
        env = spec.make(**env_kwargs)
        env.reset(seed=0)
    return env


@contextmanager
def _quiet() -> Iterator[None]:
    """Drop the output of PyBullet's C code at its import and at every connection; show Python's warnings afterwards."""
    with warnings.catch_warnings(record=True) as caught, ExitStack() as stack:
        if os.name == "posix":
            libc = ctypes.CDLL(None)
            if sys.stdout is not None:
                sys.stdout.flush()
            libc.fflush(None)
            for fd in (1, 2):
                _drop_output(fd, stack)
            stack.callback(libc.fflush, None)
        yield
    for each in caught:
        warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)


def _drop_output(fd: int, stack: ExitStack) -> None:
    with suppress(OSError):  # closed: there is nothing to drop
        kept, nothing = os.dup(fd), os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, fd)
        os.close(nothing)
        stack.callback(os.close, kept)
        stack.callback(os.dup2, kept, fd)


PYBULLET = Simulator(provides=lambda env_id: "BulletEnv-" in env_id, register=register, make=make)
