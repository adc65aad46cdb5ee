"""
The state of Python objects as JSON and arrays, and back into objects that are there already. Nothing is pickled.

``capture`` walks an object graph; ``restore`` walks the same graph, built anew, and gives it the values. What can hold
a state that Python does not see (a native object, a lock, a socket) is refused by its path: an object is captured
whole, or not at all.
"""

import types
from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper

_SCALARS = (type(None), bool, int, float, str)
MISSING: Any = object()


class NotCapturedError(TypeError):
    """An object whose state cannot be captured; the message names its path and its type."""


class NotRestoredError(ValueError):
    """A captured state that does not fit what was built; the message names the path."""


class Capture:
    """
    One walk through object graphs that may share objects.

    :param known: objects that are somebody else's to capture, by name
    """

    def __init__(self, known: dict[str, Any] | None = None):
        self.arrays: list[np.ndarray] = []
        self.left_out: list[str] = []
        self._known = {id(value): name for name, value in (known or {}).items()}
        self._seen: dict[int, int] = {}
        self._alive: list[Any] = []

    def capture(self, value: Any, path: str) -> Any:
        """
        :return: JSON
        :raises NotCapturedError: for what cannot be captured
        """
        if type(value) in _SCALARS:
            return value
        if id(value) in self._known:
            return {"known": self._known[id(value)]}
        if id(value) in self._seen:
            return {"same": self._seen[id(value)]}
        for tag, kind in KINDS.items():
            if kind.matches(value):
                if not kind.has_identity:
                    return {tag: kind.capture(self, value, path)}
                number = self._seen[id(value)] = len(self._alive)
                self._alive.append(value)
                return {tag: kind.capture(self, value, path), "number": number}
        raise NotCapturedError(f"{path} is a {name_of(type(value))}")

    def capture_attributes(self, values: dict[str, Any], path: str, optional: bool = False) -> dict[str, Any]:
        """:param optional: leave out, and note, what cannot be captured"""
        captured = {}
        for name, value in values.items():
            n_arrays, seen = len(self.arrays), dict(self._seen) if optional else {}
            try:
                captured[name] = self.capture(value, f"{path}.{name}")
            except NotCapturedError as error:
                if not optional:
                    raise
                self.left_out.append(str(error))
                del self.arrays[n_arrays:]
                self._seen = seen
        return captured

    def add_array(self, array: np.ndarray) -> int:
        """:return: its number"""
        self.arrays.append(array)
        return len(self.arrays) - 1


class Restore:
    """
    The walk back.

    :param arrays: of the :class:`Capture`
    :param known: as there
    :param step: the timestep of the capture
    """

    def __init__(self, arrays: list[np.ndarray], known: dict[str, Any] | None = None, step: int = 0):
        self.arrays, self.known, self.step = arrays, known or {}, step
        self.restarted: list[str] = []
        self._seen: dict[int, Any] = {}

    def restore(self, node: Any, existing: Any, path: str) -> Any:
        """
        :param node: what was captured
        :param existing: what is there now, of which objects are kept
        :return: the value
        :raises NotRestoredError: if it does not fit
        """
        if type(node) in _SCALARS:
            return node
        tag, content = next(iter(node.items()))
        if tag == "known":
            return self.known[content]
        if tag == "same":
            if content not in self._seen:
                raise NotRestoredError(f"{path} was part of what could not be restored")
            return self._seen[content]
        if "number" in node:
            self._seen[node["number"]] = existing  # until it is there: an object is, a container in itself is not
        value = KINDS[tag].restore(self, content, existing, path)
        if "number" in node:
            self._seen[node["number"]] = value
        return value

    def restore_attributes(self, nodes: dict[str, Any], owner: Any, path: str) -> None:
        """Set the attributes of an object."""
        for name, node in nodes.items():
            existing = attributes_of(owner).get(name, MISSING)
            value = self.restore(node, existing, f"{path}.{name}")
            if value is not existing:
                object.__setattr__(owner, name, value)


class Kind:
    """How one kind of value is captured and restored."""

    has_identity = True

    def __init__(
        self,
        matches: Callable[[Any], bool],
        capture: Callable[[Capture, Any, str], Any],
        restore: Callable[[Restore, Any, Any, str], Any],
        has_identity: bool = True,
    ):
        self.matches, self.capture, self.restore, self.has_identity = matches, capture, restore, has_identity


def plain(
    matches: Callable[[Any], bool], capture: Callable[[Any], dict[str, Any]], restore: Callable[[Any, Any], Any]
) -> Kind:
    """
    A kind whose state is a dict of plain values.

    :param restore: takes the existing value and this dict, returns the value
    """

    def restore_content(context: Restore, content: Any, existing: Any, path: str) -> Any:
        state = {name: context.restore(node, MISSING, f"{path}.{name}") for name, node in content.items()}
        return restore(existing, state)

    return Kind(matches, lambda context, value, path: context.capture_attributes(capture(value), path), restore_content)


def existing_as(kind: Any, existing: Any, path: str) -> Any:
    """:raises NotRestoredError: unless what is there is of a kind"""
    if not isinstance(existing, kind):
        found = "nothing" if existing is MISSING else f"a {name_of(type(existing))}"
        raise NotRestoredError(f"{path} was a {name_of(kind)}, and is {found}")
    return existing


# How each kind is captured and restored: the first that matches counts (kinds.py)
KINDS: dict[str, Kind] = {}
LAST = "object"


def add_kind(tag: str, kind: Kind) -> None:
    """Capture something in its own way, before it is looked at as a Python object."""
    last = KINDS.pop(LAST)
    KINDS[tag] = kind
    KINDS[LAST] = last


def name_of(kind: Any) -> str:
    """:return: of a class or function, with its module"""
    return f"{getattr(kind, '__module__', '')}.{getattr(kind, '__qualname__', kind)}"


# Attributes that are set by SB3 when training begins, or are whose state is captured elsewhere
_SKIPPED: dict[type, set[str]] = {
    BaseCallback: {"model", "locals", "globals", "parent"},
    VecEnvWrapper: {"class_attributes"},
}


def attributes_of(value: Any) -> dict[str, Any]:
    """:return: all of an object, those in slots too, by name"""
    skipped = {name for kind, names in _SKIPPED.items() if isinstance(value, kind) for name in names}
    slots = [name for c in type(value).__mro__ for name, v in vars(c).items() if is_slot(v)]
    attributes = {name: getattr(value, name) for name in slots if hasattr(value, name)}
    attributes.update(getattr(value, "__dict__", {}))
    return {name: item for name, item in attributes.items() if name not in skipped}


def is_slot(value: Any) -> bool:
    """Whether an attribute of a class is a slot of its objects."""
    return isinstance(value, types.MemberDescriptorType)
