"""What the values of a file have in common, and one way to say that one is not allowed."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
from typing import Any

from sb3_tdc.common.untrusted import escaped
from sb3_tdc.safe_load.budget import UnsafeFileError

MAX_ITEMS = 64  # of a list or mapping in the arguments of a network or an optimizer, and of a Dict space


@contextmanager
def reading(what: str) -> Iterator[None]:
    """Make whatever a damaged file makes a library raise one error of one sentence, with its place before it."""
    try:
        yield
    except Exception as error:
        reason = next(iter((str(error)[:2000].strip() or type(error).__name__).splitlines()))
        raise UnsafeFileError(f"{what}: {escaped(reason)}") from error


def is_plain(value: Any, depth: int = 0) -> bool:
    """Return whether a value is of finite numbers, texts, booleans, None and classes, in short lists and mappings."""
    if isinstance(value, (bool, str, type, type(None), Enum)):
        return True
    if isinstance(value, (int, float)):
        return math.isfinite(value) and abs(value) < 2**63
    if isinstance(value, dict):
        return is_plain([*value, *value.values()], depth)
    if isinstance(value, (list, tuple)):
        return depth < 4 and len(value) <= MAX_ITEMS and all(is_plain(item, depth + 1) for item in value)
    return False
