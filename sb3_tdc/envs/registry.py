"""From an environment id to a registered environment: packages, simulators, and the errors if there is none."""

import difflib
import importlib
from collections.abc import Sequence

import gymnasium as gym

from sb3_tdc.common.exceptions import FAILURES, describe_exception
from sb3_tdc.envs.isaac import ISAAC
from sb3_tdc.envs.mujoco import check_opengl
from sb3_tdc.envs.pybullet import PYBULLET
from sb3_tdc.envs.simulator import GYMNASIUM, Simulator

# The first simulator in this order that provides an environment registers and makes it
SIMULATORS = (PYBULLET, ISAAC, GYMNASIUM)


def simulator_of(env_id: str) -> Simulator:
    """Return the simulator that provides an environment."""
    return next(simulator for simulator in SIMULATORS if simulator.provides(env_id))


def is_of_mujoco(env_id: str) -> bool:
    """Return whether a registered environment is one of Gymnasium's MuJoCo tasks."""
    return "mujoco" in str(gym.spec(env_id).entry_point)


def has_vector_env(env_id: str) -> bool:
    """Return whether a custom vector environment is registered for an id."""
    return gym.spec(env_id).vector_entry_point is not None


def split_env_id(env_id: str, packages: Sequence[str]) -> tuple[str, list[str]]:
    """
    Split ``package:Env-v0``.

    :param packages: packages that are named elsewhere
    :return: the environment's id without the package, and all packages
    :raises ValueError: if a package is not the name of a module
    """
    package, _, env_id = env_id.rpartition(":")
    packages = [*packages, *([package] if package and package not in packages else [])]
    for package in packages:
        if not all(part.isidentifier() for part in package.split(".")):
            raise ValueError(
                f"--gym-packages takes names of modules, got {package!r}: a run folder goes before this flag"
            )
    return env_id, packages


def _import_packages(packages: Sequence[str]) -> None:
    """
    Import packages that register environments.

    :raises ValueError: if a package or one of its imports is not installed, with the remedy, or raises an exception
    """
    for package in packages:
        try:
            importlib.import_module(package)
        except ModuleNotFoundError as error:
            raise ValueError(
                f"--gym-packages {package}: there is no module {error.name!r}: "
                f"if it is a file of yours, put its folder on PYTHONPATH; otherwise pip install {error.name}"
            ) from error
        except FAILURES as error:
            raise ValueError(f"--gym-packages {package}: {describe_exception(error)}") from error


def require_env(env_id: str, packages: Sequence[str] = ()) -> None:
    """
    Import the packages that register an environment, or let its simulator register it, and check that it is registered.

    :raises ValueError: if the simulator or a package is not installed, with the command that installs it; if a package
        raises an exception; if MuJoCo finds no OpenGL; if there is no such environment, with the ids closest to it
    """
    simulator = simulator_of(env_id)
    simulator.start()
    _import_packages(packages)
    if env_id not in gym.registry:
        simulator.register()
    if env_id in gym.registry:
        if is_of_mujoco(env_id):
            check_opengl()
        return
    close = difflib.get_close_matches(env_id, gym.registry, n=3)
    nearest = f"; did you mean {' or '.join(close)}?" if close else "."
    raise ValueError(
        f"There is no environment {env_id!r}{nearest} "
        "An environment of another package is registered by --gym-packages PACKAGE."
    )
