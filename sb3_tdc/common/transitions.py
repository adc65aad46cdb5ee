"""Checks that keep non-finite transitions out of the replay buffer of any of SB3's off-policy algorithms."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_tdc.common.finite import NonFiniteError

_LARGEST = float(np.finfo(np.float32).max)  # rewards and actions are stored, and networks compute, in float32


def check_transition(
    model: OffPolicyAlgorithm,
    action: np.ndarray,
    new_obs: np.ndarray | dict[str, np.ndarray],
    reward: np.ndarray,
    dones: np.ndarray,
    infos: list[dict[str, Any]],
) -> None:
    """
    Check that a transition is finite before it is stored, and stays finite in the type in which it is stored.

    :param action: scaled actions, as the replay buffer stores them
    :raises NonFiniteError: if a number is NaN or infinite, or too large for the type in which it is stored
    """
    for name, value, largest in _parts(model, action, new_obs, reward, dones, infos):
        if not _is_finite(value, largest):
            source = "policy chose an" if name == "action" else "environment returned a non-finite"
            size = f", infinite in {_name_of(largest)}," if np.isfinite(value).all() else ""
            raise NonFiniteError(
                f"The {source} {name} of {np.asarray(value)}{size} at timestep {model.num_timesteps} "
                f"(update {model._n_updates}). Training has stopped; the transition was not stored."
            )


def check_first_observation(model: OffPolicyAlgorithm) -> None:
    """
    Check that the observations with which training begins are finite.

    :raises NonFiniteError: if a number is NaN or infinite
    """
    normalization = model.get_vec_normalize_env()
    for observation in (model._last_obs, normalization and normalization.get_original_obs()):
        if observation is not None:
            for name, value, largest in _observations(model, observation):
                if not _is_finite(value, largest):
                    raise NonFiniteError(f"The environment's reset returned a non-finite {name} of {value}.")


def _is_finite(value: Any, largest: float) -> bool:
    array = np.asarray(value)  # environments may return numbers and lists
    return array.dtype.kind != "f" or bool((np.abs(array) <= largest).all())


def _parts(
    model: OffPolicyAlgorithm, action: Any, new_obs: Any, reward: Any, dones: Any, infos: list[dict[str, Any]]
) -> Iterator[tuple[str, Any, float]]:
    normalization = model.get_vec_normalize_env()
    yield "action", action, _LARGEST
    yield "reward", reward, _LARGEST
    yield from _observations(model, new_obs)
    if normalization is not None:  # these values are stored
        yield "reward", normalization.get_original_reward(), _LARGEST
        yield from _observations(model, normalization.get_original_obs())
    for info, done in zip(infos, dones, strict=True):
        last = info.get("terminal_observation") if done else None  # new_obs already belongs to the next episode
        if last is not None:
            if normalization is not None:
                last = normalization.unnormalize_obs(last)
            yield from _observations(model, last, "terminal observation")


def _observations(
    model: OffPolicyAlgorithm, observation: Any, name: str = "observation"
) -> Iterator[tuple[str, Any, float]]:
    space = model.observation_space
    if not isinstance(observation, dict):
        yield name, observation, _largest(space)
    elif isinstance(space, spaces.Dict):
        yield from ((key, observation[key], _largest(part)) for key, part in space.spaces.items() if key in observation)


def _largest(space: spaces.Space) -> float:
    return float(np.finfo(np.float16).max) if space.dtype == np.float16 else _LARGEST


def _name_of(largest: float) -> str:
    return "float32" if math.isclose(largest, _LARGEST) else "float16"
