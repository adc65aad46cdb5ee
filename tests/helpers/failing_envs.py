"""Environments that fail. They import little, since each process of an environment imports this module."""

import multiprocessing
import os
import signal

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control import PendulumEnv


class Dies(PendulumEnv):
    """An environment that cannot be made in the second process."""

    def __init__(self):
        super().__init__()
        if multiprocessing.current_process().name.endswith("2"):
            raise RuntimeError("no licence")


class Raises(PendulumEnv):
    """:param how: what goes wrong from step ``at`` of this environment on; "reset": at every reset"""

    def __init__(self, how="raise", at=250):
        super().__init__()
        self.how, self.at, self.count = how, at, 0

    def reset(self, **kwargs):
        if self.how == "reset":
            raise RuntimeError("no scene\nto load")
        return super().reset(**kwargs)

    def step(self, action):
        self.count += 1
        observation, reward, *rest = super().step(action)
        if self.count < self.at:
            return observation, reward, *rest
        if self.how == "raise":
            raise ZeroDivisionError("in the\nsimulator")
        if self.how == "die":
            os._exit(3)
        if self.how == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        return {
            "shape": (np.zeros(5), reward, *rest),
            "type": (np.array(["a", "b", "c"]), reward, *rest),
            "none": None,
            "no observation": (None, reward, *rest),
            "no reward": (observation, None, *rest),
            "four": (observation, reward, False, {}),
        }[self.how]


gym.register("Dies-v0", Dies)
gym.register("Raises-v0", Raises, max_episode_steps=100)
