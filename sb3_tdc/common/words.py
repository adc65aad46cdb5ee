"""Helpers for numbers and lists in sentences."""

from collections.abc import Sequence


def count(n: int, noun: str) -> str:
    """Return "1 seed" for ``count(1, "seed")``, and "3 seeds" for ``count(3, "seed")``."""
    return f"{n:,} {noun}" if n == 1 else f"{n:,} {noun}s"


def counted(numbers: Sequence[int], noun: str) -> str:
    """Return "1 and 5 seeds" for ``counted([1, 5], "seed")``; ``numbers`` must be ascending and not empty."""
    *others, largest = numbers
    return listed([*map(str, others), count(largest, noun)])


def listed(words: Sequence[str]) -> str:
    """Return "a, b and c" for ``["a", "b", "c"]``."""
    return ", ".join(words[:-1]) + " and " + words[-1] if len(words) > 1 else "".join(words)


def first_of(names: Sequence[str], n: int = 3) -> str:
    """Return "a, b, c and 2 others" for ``["a", "b", "c", "d", "e"]``."""
    others = [count(len(names) - n, "other")] if len(names) > n else []
    return " and ".join([", ".join(names[:n]), *others])
