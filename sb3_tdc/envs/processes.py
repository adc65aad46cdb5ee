"""Processes of environments, which ignore the signals that stop the trainer and never outlive it."""

import multiprocessing
import signal
from collections.abc import Iterator
from contextlib import contextmanager

from stable_baselines3.common.vec_env import VecEnv

# SIGHUP: the terminal was closed (Windows has none)
STOP_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


def ignore_signals() -> None:
    """Ignore the signals that are sent to the whole process group: the trainer still needs its environments."""
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def ended_processes() -> Iterator[None]:
    """Kill the processes of environments that were started in this block and still run after it."""
    before = set(multiprocessing.active_children())
    try:
        yield
    finally:
        for process in set(multiprocessing.active_children()) - before:
            if process.daemon:
                process.kill()
                process.join()


@contextmanager
def closing_envs(env: VecEnv) -> Iterator[VecEnv]:
    """Close environments after this block; after Ctrl-C, possibly in the middle of a step, kill their processes."""
    try:
        yield env
    except KeyboardInterrupt:
        for process in getattr(env.unwrapped, "processes", []):
            process.kill()
        raise
    finally:
        env.close()
