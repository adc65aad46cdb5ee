"""One clear sentence for every bad argument: what it is, what it was, what is allowed."""

import math
from typing import Any

import numpy as np
from gymnasium import spaces


def _allowed(kind: str, minimum: float, maximum: float) -> str:
    if maximum < math.inf:
        return f"{kind} between {minimum} and {maximum}"
    return f"{kind} of at least {minimum}" if minimum > -math.inf else kind


def check_number(name: str, value: Any, minimum: float = -math.inf, maximum: float = math.inf) -> float:
    """
    :return: the value, a finite number in [minimum, maximum]
    :raises ValueError: if it is anything else
    """
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or not minimum <= value <= maximum:
        raise ValueError(f"{name} must be {_allowed('a finite number', minimum, maximum)}, got {value!r}")
    return float(value)


def check_integer(name: str, value: Any, minimum: int) -> int:
    """
    :return: the value, an integer of at least ``minimum``
    :raises ValueError: if it is anything else
    """
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < minimum:
        raise ValueError(f"{name} must be {_allowed('an integer', minimum, math.inf)}, got {value!r}")
    return int(value)


def check_action_space(action_space: spaces.Space) -> None:
    """:raises ValueError: unless the actions are a bounded ``Box``"""
    if not isinstance(action_space, spaces.Box):
        raise ValueError(f"env must have a Box action space (continuous actions), got {action_space}")
    if not (np.isfinite(action_space.low).all() and np.isfinite(action_space.high).all()):
        raise ValueError(
            f"env must have a bounded action space, got {action_space}: "
            "wrap it in gymnasium.wrappers.RescaleAction or give the Box finite bounds"
        )
    if not (action_space.low < action_space.high).all():
        raise ValueError(f"env must have an action space with low < high, got {action_space}")
