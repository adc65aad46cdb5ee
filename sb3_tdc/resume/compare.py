"""Two captures compared, without the code that restores."""

from typing import Any

import numpy as np

from sb3_tdc.resume.walk import Capture


def differences(before: Capture, after: Capture) -> list[str]:
    """
    Compare what was captured of every attribute that can be left out, bit by bit.

    :return: the paths of those that differ, of the innermost where one holds another
    """
    paths = [*before.attributes, *(path for path in after.attributes if path not in before.attributes)]
    differing = [path for path in paths if _canonical(before, path) != _canonical(after, path)]
    return [
        path
        for path in differing
        if not any(other.startswith(tuple(f"{path}{next_}" for next_ in ".[,")) for other in differing)
    ]


def _canonical(capture: Capture, path: str) -> Any:
    """Return an attribute with arrays in the place of their numbers, and objects numbered in the order they come in."""
    numbers: dict[Any, int] = {}
    first = capture.first_arrays.get(path, 0)

    def convert(node: Any) -> Any:
        if isinstance(node, dict) and "#" in node:
            array = np.asarray(capture.arrays[first + node["#"]])
            return str(array.dtype), array.shape, array.tobytes()
        if isinstance(node, dict):
            return [(key, renumber(key, item)) for key, item in node.items()]
        return [convert(item) for item in node] if isinstance(node, (list, tuple)) else repr(node)

    def renumber(key: str, item: Any) -> Any:
        if key in ("id", "same", "memory") and isinstance(item, int):
            return numbers.setdefault((key == "memory", item), len(numbers))
        return convert(item)

    return convert(capture.attributes[path]) if path in capture.attributes else None
