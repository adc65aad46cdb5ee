"""Numbers and lists in sentences."""

from collections.abc import Sequence


def count(n: int, noun: str) -> str:
    """``count(1, "seed")`` → "1 seed", ``count(3, "seed")`` → "3 seeds"."""
    return f"{n:,} {noun}" if n == 1 else f"{n:,} {noun}s"


def counted(numbers: Sequence[int], noun: str) -> str:
    """``counted([1, 5], "seed")`` → "1 and 5 seeds"; ``numbers`` must not be empty, and rise."""
    *others, largest = numbers
    return listed([*map(str, others), count(largest, noun)])


def listed(words: Sequence[str]) -> str:
    """``["a", "b", "c"]`` → "a, b and c"."""
    return ", ".join(words[:-1]) + " and " + words[-1] if len(words) > 1 else "".join(words)


def first_of(names: Sequence[str], n: int = 3) -> str:
    """``first_of(["a", "b", "c", "d", "e"])`` → "a, b, c and 2 others"."""
    others = [count(len(names) - n, "other")] if len(names) > n else []
    return " and ".join([", ".join(names[:n]), *others])
