"""Safe display of values of untrusted files in messages."""

from typing import Any


def shown(value: Any) -> str:
    """Return a short text for a value of a file: at most 60 characters of a string, and no control characters."""
    if isinstance(value, bool | float | None):
        return str(value)
    if isinstance(value, int):
        return str(value) if value.bit_length() <= 64 else f"an integer of {value.bit_length():,} bits"
    if isinstance(value, str):
        return escaped(repr(value[:60]) if len(value) <= 60 else f"{value[:60]!r}…")
    if isinstance(value, type):
        return f"the class {escaped(value.__name__)}"
    return f"a {escaped(type(value).__name__)}"


def escaped(text: str, length: int = 300) -> str:
    """Return the first ``length`` characters of a text, with escapes for those that are not printable."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text[:length])
