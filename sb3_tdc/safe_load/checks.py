"""What a value of a file may be, and one way to say that it is not."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from sb3_tdc.safe_load.inert_pickle import UnsafeFileError
from sb3_tdc.tdc.checks import check_integer

MAX_ITEMS = 64  # of a list or mapping in the arguments of a network or an optimizer


@contextmanager
def reading(what: str) -> Iterator[None]:
    """Whatever a damaged file makes a library raise becomes one error of one sentence, with its place before it."""
    try:
        yield
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:300]
        raise UnsafeFileError(f"{what}: {reason}") from error


def integer(minimum: int, maximum: int = 2**62) -> Callable[[str, Any], int]:
    """:return: a check of a field, as :func:`boolean` is one"""

    def check(name: str, value: Any) -> int:
        number = check_integer(name, value, minimum)
        if number > maximum:
            raise ValueError(f"{name} must be at most {maximum:,}, got {number:,}")
        return number

    return check


def boolean(name: str, value: Any) -> bool:
    """
    A check of a field.

    :return: the value
    :raises ValueError: unless it is True or False
    """
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be true or false, got {value!r:.100}")
    return value


def is_plain(value: Any, depth: int = 0) -> bool:
    """Whether a value is of finite numbers, texts, booleans, None and classes, in short lists and mappings."""
    if isinstance(value, (bool, str, type, type(None))):
        return True
    if isinstance(value, (int, float)):
        return math.isfinite(value) and abs(value) < 2**63
    if isinstance(value, dict):
        return is_plain([*value, *value.values()], depth)
    if isinstance(value, (list, tuple)):
        return depth < 4 and len(value) <= MAX_ITEMS and all(is_plain(item, depth + 1) for item in value)
    return False
