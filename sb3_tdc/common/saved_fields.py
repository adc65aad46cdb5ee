"""
Declarations of the fields that an algorithm saves, with a check of the values that each may have.

A check takes the name of a field and a value from an untrusted file; it returns the value, or raises a ``ValueError``.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from sb3_tdc.common.untrusted import shown

Check = Callable[[str, Any], Any]


class SavedField(NamedTuple):
    """
    A field of a saved model.

    :param check: check of the field's value
    :param is_required: whether a file without the field is refused, so that no default silently replaces it
    """

    check: Check
    is_required: bool = True


def integer(minimum: int, maximum: int = 2**62) -> Callable[[str, Any], int]:
    """Return a check that accepts integers in a range."""

    def check(name: str, value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not minimum <= value <= maximum:
            raise ValueError(f"{name} must be an integer from {minimum:,} to {maximum:,}, got {shown(value)}")
        return value

    return check


def number(
    minimum: float = -math.inf, maximum: float = math.inf, above: float = -math.inf
) -> Callable[[str, Any], float]:
    """Return a check that accepts finite numbers that are in a range and greater than ``above``."""

    def check(name: str, value: Any) -> float:
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not is_number or not math.isfinite(value) or not minimum <= value <= maximum or not value > above:
            low = f"above {above:g}" if above > -math.inf else f"from {minimum:g}"
            allowed = "" if minimum == above == -math.inf and maximum == math.inf else f" {low} to {maximum:g}"
            raise ValueError(f"{name} must be a finite number{allowed}, got {shown(value)}")
        return value

    return check


def boolean(name: str, value: Any) -> bool:
    """
    Check that a value is True or False.

    :return: the value
    :raises ValueError: if it is anything else
    """
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be true or false, got {shown(value)}")
    return value


def schedule(name: str, value: Any) -> Any:
    """Check that a value is a schedule, or a number of at least 0."""
    return value if callable(value) and not isinstance(value, type) else number(0.0)(name, value)


def text_or_number(name: str, value: Any) -> Any:
    """Check that a value is a short text or a number."""
    return value if isinstance(value, str) and len(value) < 100 else number()(name, value)


def none(name: str, value: Any) -> None:
    """Check that a value is None."""
    if value is not None:
        raise ValueError(f"{name} must be null, got {shown(value)}")


def or_none(check: Check) -> Check:
    """Return a check that also accepts None."""
    return lambda name, value: None if value is None else check(name, value)
