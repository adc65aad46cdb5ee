"""Checks of arguments, whose errors are one clear sentence: the argument, its value, and what is allowed."""

import difflib
import math
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

# The smallest and the largest allowed value of each argument, which must be an integer if the smallest is an int
Limits = Mapping[str, tuple[float, float]]
# The smallest number above 0
ABOVE_ZERO = math.nextafter(0.0, 1.0)
_POSITIVE, _NOT_NEGATIVE = (1, math.inf), (0.0, math.inf)
# Limits of SB3's off-policy algorithms and their policies
OFF_POLICY_LIMITS: Limits = {
    **dict.fromkeys(("buffer_size", "batch_size", "train_freq", "n_steps", "policy_delay"), _POSITIVE),
    **dict.fromkeys(("target_update_interval", "stats_window_size", "net_arch", "n_critics"), _POSITIVE),
    **dict.fromkeys(("learning_rate", "ent_coef", "target_policy_noise", "target_noise_clip"), _NOT_NEGATIVE),
    **dict.fromkeys(("tau", "gamma"), (0.0, 1.0)),
    "learning_starts": (0, math.inf),
    "gradient_steps": (-1, math.inf),
}


def _allowed(kind: str, minimum: float, maximum: float) -> str:
    if minimum == ABOVE_ZERO:
        return f"{kind} above 0" if maximum == math.inf else f"{kind} above 0, up to {maximum}"
    if maximum < math.inf:
        return f"{kind} between {minimum} and {maximum}"
    return f"{kind} of at least {minimum}" if minimum > -math.inf else kind


def _as_number(value: Any) -> float:
    """Convert a value to a float; return NaN for a text, a truth value, or anything else that is not a number."""
    if isinstance(value, (str, bytes, bool, np.bool_)):
        return math.nan
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        return math.nan


def check_number(name: str, value: Any, minimum: float = -math.inf, maximum: float = math.inf) -> float:
    """
    Check a number.

    :return: the value, a finite number in [minimum, maximum]
    :raises ValueError: if it is anything else
    """
    number = _as_number(value)
    if not math.isfinite(number) or not minimum <= number <= maximum:
        raise ValueError(f"{name} must be {_allowed('a finite number', minimum, maximum)}, got {value!r}")
    return number


def check_integer(name: str, value: Any, minimum: int, maximum: float = math.inf) -> int:
    """
    Check an integer.

    :return: the value, an integer in [minimum, maximum]; a whole float such as 1e6 counts as one
    :raises ValueError: if it is anything else
    """
    is_integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    number = value if is_integer else _as_number(value)
    if not math.isfinite(number) or number != int(number) or not minimum <= number <= maximum:
        raise ValueError(f"{name} must be {_allowed('an integer', minimum, maximum)}, got {value!r}")
    return int(number)


def check_within(limits: Limits, name: str, value: Any, shown_as: str = "") -> float:
    """
    Check a number against the limits of an argument.

    :param name: name of the argument, a key of the limits
    :param shown_as: name of the argument in the error; ``name`` by default
    :return: the value, a number or an integer
    :raises ValueError: if it is anything else
    """
    minimum, maximum = limits[name]
    if isinstance(minimum, int):
        return check_integer(shown_as or name, value, minimum, maximum)
    return check_number(shown_as or name, value, minimum, maximum)


def check_layers(name: str, layers: Any, networks: Collection[str] = ()) -> None:
    """
    Check the units of hidden layers.

    :param networks: names of the networks that may have layers of their own, in a dict
    :raises ValueError: if it is not a list of integers of at least 1, nor a dict of such lists with these names; a
        tuple counts as a list
    """
    is_dict = bool(networks) and isinstance(layers, dict) and layers.keys() == set(networks)
    lists = layers.values() if is_dict else [layers]
    if not all(isinstance(each, (list, tuple)) and all(_is_width(units) for units in each) for each in lists):
        or_dict = f", or a dict of such lists for {' and '.join(networks)}" if networks else ""
        raise ValueError(f"{name} must be a list of integers of at least 1{or_dict}, got {layers!r}")


def _is_width(units: Any) -> bool:
    return isinstance(units, (int, np.integer)) and not isinstance(units, bool) and int(units) >= 1


def check_boolean(name: str, value: Any, or_none: bool = False) -> bool | None:
    """
    Check a truth value, because a text such as "False" would count as true.

    :param or_none: whether None is allowed too, and returned
    :return: the value, True or False
    :raises ValueError: if it is anything else
    """
    if isinstance(value, (bool, np.bool_)) or (or_none and value is None):
        return None if value is None else bool(value)
    raise ValueError(f"{name} must be True{', False or None' if or_none else ' or False'}, got {value!r}")


def check_action_space(action_space: spaces.Space) -> None:
    """
    Check that an action space is a bounded ``Box`` of floats.

    :raises ValueError: if it is anything else
    """
    if not isinstance(action_space, spaces.Box):
        raise ValueError(f"env must have a Box action space (continuous actions), got {action_space}")
    if not (np.isfinite(action_space.low).all() and np.isfinite(action_space.high).all()):
        raise ValueError(
            f"env must have a bounded action space, got {action_space}: "
            "wrap it in gymnasium.wrappers.RescaleAction or give the Box finite bounds"
        )
    if not (action_space.low < action_space.high).all():
        raise ValueError(f"env must have an action space with low < high, got {action_space}")
    if not np.issubdtype(action_space.dtype, np.floating):
        raise ValueError(f"env must have an action space of floating-point numbers, got {action_space}")
    with np.errstate(over="ignore"):
        widths = action_space.high - action_space.low
    if not np.isfinite(widths).all():
        raise ValueError(
            f"env must have an action space whose width, high − low, is finite in {action_space.dtype}, got "
            f"{action_space}: wrap it in gymnasium.wrappers.RescaleAction or give the Box narrower bounds"
        )


def check_observation_space(space: spaces.Space) -> None:
    """
    Check that SB3's networks can take the observations of a space.

    The networks flatten all axes but the first, the batch axis.

    :raises ValueError: if the space, or a part of a ``Dict``, is a ``Box`` without axes
    """
    parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    for name, part in parts.items():
        if isinstance(part, spaces.Box) and part.shape == ():
            got = f"{part} in {name!r}" if name else part
            raise ValueError(f"env must have observations of at least one axis, got {got}: give it the shape (1,)")


def check_device(name: str, device: str, remedy: str = "") -> None:
    """
    Check that a device exists on this machine, if it is a CPU or a GPU.

    Without a GPU, SB3 would compute on the CPU instead.

    :param name: name of the argument, for the error
    :param remedy: the end of the error's sentence
    :raises ValueError: if there is no such device; the error lists the devices of this machine
    """
    n_gpus = {"cpu": 1, "cuda": th.cuda.device_count(), "mps": int(th.backends.mps.is_available())}
    try:
        parsed = None if device == "auto" else th.device(device)
        is_there = parsed is None or (parsed.index or 0) < n_gpus.get(parsed.type, math.inf)
    except RuntimeError:
        is_there = False
    if not is_there:
        gpus = ["cuda", *(f"cuda:{i}" for i in range(n_gpus["cuda"]))] if n_gpus["cuda"] else []
        there = ["auto", "cpu", *gpus, *["mps"] * n_gpus["mps"]]
        raise ValueError(f"{name} must be one of {', '.join(there)} on this machine, got {device!r}{remedy}")


def suggest(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean ...?" with the most similar known name, or an empty string if none is similar."""
    by_lower = {str(k).lower(): k for k in known}
    nearest = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=0.6)
    return f"; did you mean {by_lower[nearest[0]]!r}?" if nearest else ""


def unknown(kind: str, name: str, known: Iterable[str]) -> str:
    """Return an error message for an unknown name, with the most similar known name and the list of all of them."""
    known = list(known)
    return f"unknown {kind} {name!r}{suggest(name, known)}; known: {', '.join(known)}"
