"""Comparison of two captures, independent of the code that restores them."""

from typing import Any

import numpy as np

from sb3_tdc.resume.walk import Capture


def differences(before: Capture, after: Capture) -> list[str]:
    """
    Compare two captures bit by bit, for every attribute that may be left out of a state.

    :return: the paths of the attributes that differ; if one attribute contains another, only the innermost
    """
    paths = [*before.attributes, *(path for path in after.attributes if path not in before.attributes)]
    differing = [path for path in paths if _canonical(before, path) != _canonical(after, path)]
    return [
        path
        for path in differing
        if not any(other.startswith(tuple(f"{path}{next_}" for next_ in ".[,")) for other in differing)
    ]


def _canonical(capture: Capture, path: str) -> Any:
    """
    Return a captured attribute in a form that can be compared across captures.

    References to arrays are replaced by the arrays, and objects are numbered in the order in which they appear.

    :return: the converted attribute; None if the capture does not contain it
    """
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
