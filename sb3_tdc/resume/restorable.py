"""Wrapper that gives a run access to environments in other processes."""

import pickle
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from sb3_tdc.resume.environments import capture_env, restore_env
from sb3_tdc.resume.kinds.table import KINDS
from sb3_tdc.resume.locations import Locations


class Restorable(gym.Wrapper):
    """Wrapper that captures and restores an environment in the process in which ``SubprocVecEnv`` runs it."""

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]  # a property in Wrapper, too
        """Return the environment's spec, shortened if it cannot be sent to another process: it may hold functions."""
        spec = self.env.spec
        try:
            pickle.dumps(spec)
        except Exception:  # pickling an object may raise anything
            assert spec is not None
            return EnvSpec(spec.id, reward_threshold=spec.reward_threshold, max_episode_steps=spec.max_episode_steps)
        return spec

    def capture_state(self) -> dict[str, Any]:
        """Capture the environment, as :func:`~sb3_tdc.resume.environments.capture_env` does."""
        return capture_env(KINDS, self)

    def restore_state(self, state: dict[str, Any], with_files: bool, locations: Locations) -> str | None:
        """Restore the environment, as :func:`~sb3_tdc.resume.environments.restore_env` does."""
        return restore_env(KINDS, self, state, with_files, locations)
