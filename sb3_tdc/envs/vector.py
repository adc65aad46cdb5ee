"""
Gymnasium's vector environments as SB3's ``VecEnv``: those of ``gym.make_vec``, and of massively parallel simulators.

SB3 expects the step that ends an episode to return the first observation of the next one, and its info to hold the
last observation. How to obtain both depends on Gymnasium's autoreset mode:

- SAME_STEP: the environment resets itself in that step; last observation and info are in ``final_obs``, ``final_info``.
- NEXT_STEP: for an environment that has ended, the next step would ignore the action, and return the first observation
  and a reward of 0. That is no transition and must not be learnt from, so the environment is reset at once instead. If
  all have ended, they are reset by taking that next step at once.
- DISABLED: the caller has to reset the environment, which is done here.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, VectorEnv
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

_SAME_STEP = getattr(getattr(gym.vector, "AutoresetMode", None), "SAME_STEP", "SameStep")
_REMEDY = "make it with autoreset_mode=AutoresetMode.SAME_STEP"


class GymnasiumVecEnv(VecEnv):
    """
    Any of Gymnasium's vector environments, with NumPy arrays or tensors, as a ``VecEnv``.

    :param env: with any autoreset mode; for NEXT_STEP and DISABLED, its ``reset`` must support the option
        ``reset_mask``, as Gymnasium's own environments do since 1.1
    :raises ValueError: if SB3 does not support its observation space, or it cannot reset single environments properly
    """

    def __init__(self, env: VectorEnv):
        if isinstance(env.single_observation_space, spaces.Tuple):
            raise ValueError(f"SB3 knows no Tuple observations, and {env} has them")
        self.env = env
        mode = env.metadata.get("autoreset_mode", "NextStep")  # Gymnasium 1.0 has only this mode, and no such entry
        name = getattr(mode, "value", mode)
        self.resets_itself, self._resets_in_next_step = name == "SameStep", name == "NextStep"
        if isinstance(env.unwrapped, AsyncVectorEnv) and not env.unwrapped.shared_memory and mode is not _SAME_STEP:
            # Its processes would reset again in the next step (Gymnasium 1.4)
            raise ValueError(f"{env} without shared memory resets twice: {_REMEDY}")
        self._actions: np.ndarray | None = None
        self._can_reset_some: bool | None = None  # not known yet
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> VecEnvObs:
        options = self._common_options()
        # Some environments accept only a single seed; Gymnasium counts up from it for the others, as SB3's seed() does
        seed = None if self._seeds[0] is None else int(self._seeds[0])
        seeded: Any = {"seed": seed, "options": options} if options else {"seed": seed}
        observations, infos = self.env.reset(**seeded)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = split_infos(infos, self.num_envs)
        return copy_of(to_numpy(observations))  # the next step may write into the same memory

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        results = self.env.step(self._actions)
        observations, rewards, terminated, truncated = map(to_numpy, results[:4])
        infos = split_infos(results[4], self.num_envs)
        terminated, truncated = terminated.astype(bool), truncated.astype(bool)
        dones = terminated | truncated
        if dones.any():
            observations, infos = self._end_episodes(observations, infos, dones)
            for i in map(int, np.flatnonzero(dones)):
                infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
        return copy_of(observations), rewards.astype(np.float32), dones, infos

    def _end_episodes(
        self, observations: Any, infos: list[dict[str, Any]], dones: np.ndarray
    ) -> tuple[Any, list[dict[str, Any]]]:
        """Return the first observations of the next episodes, and infos with the last ones of the ended episodes."""
        if self.resets_itself:
            for i in map(int, np.flatnonzero(dones)):
                last, final = infos[i].pop("final_obs"), infos[i].pop("final_info", {})
                self.reset_infos[i] = infos[i]
                infos[i] = {**final, "terminal_observation": to_numpy(last)}
            return observations, infos
        for i in map(int, np.flatnonzero(dones)):
            infos[i]["terminal_observation"] = take(observations, i)
        first, reset_infos = self._reset_some(observations, dones)
        for index, info in enumerate(split_infos(reset_infos, self.num_envs)):
            if dones[index]:
                self.reset_infos[index] = info
        return first, infos

    def _reset_some(self, observations: Any, mask: np.ndarray) -> tuple[Any, dict[str, Any]]:
        if mask.all() and self._resets_in_next_step:  # works even if single environments cannot be reset
            results = self.env.step(self._actions)
            return to_numpy(results[0]), results[4]
        before = copy_of(observations)
        results, infos = self.env.reset(options={"reset_mask": mask.copy()})
        results = to_numpy(results)
        if self._can_reset_some is None and not mask.all():
            self._can_reset_some = all(
                _equal(take(before, i), take(results, i)) for i in map(int, np.flatnonzero(~mask))
            )
            if not self._can_reset_some:
                raise ValueError(f"{self.env} cannot reset single environments (options reset_mask): {_REMEDY}")
        return results, infos

    def _common_options(self) -> dict[str, Any]:
        if any(options != self._options[0] for options in self._options):
            raise ValueError("Gymnasium's vector environments take the same reset options for all environments")
        return dict(self._options[0])

    def close(self) -> None:
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        frames: Any = self.env.render()
        return [None] * self.num_envs if frames is None else list(frames)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        chosen = list(self._get_indices(indices))
        if hasattr(self.env, "get_attr"):
            values = self.env.get_attr(attr_name)
        else:
            values = [getattr(self.env, attr_name)] * self.num_envs
        return [values[i] for i in chosen]

    @property
    def has_single_envs(self) -> bool:
        """Whether methods can be called on a single environment, and not only on all at once."""
        return self._envs is not None or (self.num_envs == 1 and hasattr(self.env, "call"))

    @property
    def _envs(self) -> Sequence[gym.Env] | None:
        envs = getattr(self.env, "envs", None)
        return envs if envs and all(isinstance(env, gym.Env) for env in envs) else None

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        chosen = self._choose("set_attr", indices)
        if chosen is not None:
            for env in chosen:
                env.set_wrapper_attr(attr_name, value)
            return
        if not hasattr(self.env, "set_attr"):
            raise AttributeError(f"{self.env} cannot set attributes of its environments ({attr_name})")
        self.env.set_attr(attr_name, [value] * self.num_envs)  # Gymnasium takes a list as a value for each

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        chosen = self._choose("env_method", indices)
        if chosen is not None:
            return [env.get_wrapper_attr(method_name)(*method_args, **method_kwargs) for env in chosen]
        if not hasattr(self.env, "call"):
            raise AttributeError(f"{self.env} cannot call methods of its environments ({method_name})")
        return list(self.env.call(method_name, *method_args, **method_kwargs))

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        from stable_baselines3.common.env_util import is_wrapped

        envs = self._envs
        chosen = self._get_indices(indices)
        return [envs is not None and is_wrapped(envs[i], wrapper_class) for i in chosen]

    def _choose(self, what: str, indices: Any) -> list[gym.Env] | None:
        """Return the chosen environments, or None for all of a vector environment that holds no single ones."""
        chosen = list(self._get_indices(indices))
        if self._envs is not None:
            return [self._envs[i] for i in chosen]
        if sorted(chosen) != list(range(self.num_envs)):
            raise ValueError(f"{what} of {self.env} is for all environments at once")
        return None


def to_numpy(value: Any) -> Any:
    """Return an array, a tensor on any device, or a dict of these as arrays of NumPy."""
    if isinstance(value, dict):
        return {key: to_numpy(part) for key, part in value.items()}
    return value.detach().cpu().numpy() if hasattr(value, "detach") else np.asarray(value)


def copy_of(observations: Any) -> Any:
    """Return a copy of observations."""
    if isinstance(observations, dict):
        return {key: copy_of(part) for key, part in observations.items()}
    return observations.copy()


def take(observations: Any, i: int) -> Any:
    """Return a copy of the observation of one environment."""
    if isinstance(observations, dict):
        return {key: take(part, i) for key, part in observations.items()}
    return np.array(observations[i])


def split_infos(infos: dict[str, Any], n_envs: int) -> list[dict[str, Any]]:
    """
    Split the infos of a vector environment into one dict for each environment.

    :param infos: arrays by name, each with a mask ``_name`` of the environments that have this info; a value that does
        not have one part per environment belongs to all environments
    """
    split: list[dict[str, Any]] = [{} for _ in range(n_envs)]
    names = [name for name in infos if not (name.startswith("_") and name[1:] in infos)]
    for name in names:
        mask = to_numpy(infos.get(f"_{name}", np.ones(n_envs, dtype=bool)))
        values = infos[name]
        parts: Any = split_infos(values, n_envs) if isinstance(values, dict) else values
        parts = to_numpy(parts) if hasattr(parts, "detach") else parts
        # A single value for all, for instance a log
        is_of_all = isinstance(parts, str) or not hasattr(parts, "__len__") or len(parts) != n_envs
        for i in map(int, np.flatnonzero(mask)):
            split[i][name] = parts if is_of_all else parts[i]
    return split


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return all(_equal(part, other[key]) for key, part in one.items())
    return bool(np.array_equal(one, other, equal_nan=one.dtype.kind == "f"))
