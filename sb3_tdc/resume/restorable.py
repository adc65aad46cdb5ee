"""The access of a run to environments in other processes."""

from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from sb3_tdc.resume.environments import capture_env, restore_env
from sb3_tdc.resume.kinds.table import KINDS
from sb3_tdc.resume.locations import Locations


class Restorable(gym.Wrapper):
    """Capture and restore an environment in another process: ``SubprocVecEnv`` calls these methods there."""

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]  # a property in Wrapper, too
        """The environment's spec without the functions that it may hold, which cannot be sent from another process."""
        spec = self.env.spec
        if spec is None:
            return None
        return EnvSpec(spec.id, reward_threshold=spec.reward_threshold, max_episode_steps=spec.max_episode_steps)

    def capture_state(self) -> dict[str, Any]:
        """Capture the environment, as :func:`~sb3_tdc.resume.environments.capture_env` does."""
        return capture_env(KINDS, self)

    def restore_state(self, state: dict[str, Any], with_files: bool, locations: Locations) -> str | None:
        """Restore the environment, as :func:`~sb3_tdc.resume.environments.restore_env` does."""
        return restore_env(KINDS, self, state, with_files, locations)
