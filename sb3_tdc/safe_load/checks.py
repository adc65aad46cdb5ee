"""What a value of a file may be, and one way to say that it is not."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum
from typing import Any

from sb3_tdc.safe_load.budget import UnsafeFileError, escaped, shown

MAX_ITEMS = 64  # of a list or mapping in the arguments of a network or an optimizer


@contextmanager
def reading(what: str) -> Iterator[None]:
    """Whatever a damaged file makes a library raise becomes one error of one sentence, with its place before it."""
    try:
        yield
    except Exception as error:
        reason = next(iter((str(error)[:2000].strip() or type(error).__name__).splitlines()))
        raise UnsafeFileError(f"{what}: {escaped(reason)}") from error


def integer(minimum: int, maximum: int = 2**62) -> Callable[[str, Any], int]:
    """:return: a check of a field, as :func:`boolean` is one"""

    def check(name: str, value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not minimum <= value <= maximum:
            raise ValueError(f"{name} must be an integer from {minimum:,} to {maximum:,}, got {shown(value)}")
        return value

    return check


def number(
    minimum: float = -math.inf, maximum: float = math.inf, above: float = -math.inf
) -> Callable[[str, Any], float]:
    """:return: a check of a field: a finite number in a range, which does not hold ``above``"""

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
    A check of a field.

    :return: the value
    :raises ValueError: unless it is True or False
    """
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be true or false, got {shown(value)}")
    return value


def is_plain(value: Any, depth: int = 0) -> bool:
    """Whether a value is of finite numbers, texts, booleans, None and classes, in short lists and mappings."""
    if isinstance(value, (bool, str, type, type(None), Enum)):
        return True
    if isinstance(value, (int, float)):
        return math.isfinite(value) and abs(value) < 2**63
    if isinstance(value, dict):
        return is_plain([*value, *value.values()], depth)
    if isinstance(value, (list, tuple)):
        return depth < 4 and len(value) <= MAX_ITEMS and all(is_plain(item, depth + 1) for item in value)
    return False
