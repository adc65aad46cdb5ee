"""Common parts of the readers: one kind of error, and a check for plain values."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
from typing import Any

from sb3_tdc.common.untrusted import escaped
from sb3_tdc.safe_load.budget import UnsafeFileError

MAX_ITEMS = 64  # in a list or mapping of the arguments of a network or an optimizer, and in a Dict space


@contextmanager
def reading(what: str) -> Iterator[None]:
    """
    Turn any exception that a damaged file causes, also in a library, into an error of one sentence.

    :param what: the beginning of the sentence: the file or the part that is being read
    :raises UnsafeFileError: for any exception
    """
    try:
        yield
    except Exception as error:
        reason = next(iter((str(error)[:2000].strip() or type(error).__name__).splitlines()))
        raise UnsafeFileError(f"{what}: {escaped(reason)}") from error


def is_plain(value: Any, depth: int = 0) -> bool:
    """
    Return whether a value is plain.

    Plain values are finite numbers, texts, booleans, None, classes and enums, and short lists and mappings of these.
    """
    if isinstance(value, (bool, str, type, type(None), Enum)):
        return True
    if isinstance(value, (int, float)):
        return math.isfinite(value) and abs(value) < 2**63
    if isinstance(value, dict):
        return is_plain([*value, *value.values()], depth)
    if isinstance(value, (list, tuple)):
        return depth < 4 and len(value) <= MAX_ITEMS and all(is_plain(item, depth + 1) for item in value)
    return False
