"""
The state of Python objects as JSON and arrays, and back into objects that are there already. Nothing is pickled.

``capture`` walks an object graph; ``restore`` walks the same graph, built again, and gives it the values. What can hold
a state that Python does not see (a native object, a lock, a socket) is refused by its path: an object is captured
whole, or not at all. Some values are made from what was captured alone; others have to be there already (an object of
a class, a function). :func:`uncovered` says which of these were not there when training began, and so will not be when
the run is resumed.
"""

import itertools
import types
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper
from torch import nn

from sb3_tdc.resume.locations import UNMOVED, Locations

MISSING: Any = object()
# Deeper nesting could be captured, but not restored within Python's limit of recursion
_DEEPEST = 100


class NotCapturedError(TypeError):
    """An object whose state cannot be captured; the message names its path and its type."""


class NotRestoredError(ValueError):
    """A captured state that does not fit what was built; the message names the path."""


def is_scalar(value: Any) -> bool:
    """Return whether JSON gives a value back as it was."""
    if type(value) is int:
        return abs(value) < 1 << 63
    if type(value) is str:
        return value.isascii() or not any("\ud800" <= letter <= "\udfff" for letter in value)
    return value is None or type(value) in (bool, float)


def _is_same_scalar(a: Any, b: Any) -> bool:
    return type(a) is type(b) and (repr(a) == repr(b) if type(a) is float else a == b)


def head(node: dict[str, Any]) -> tuple[str, Any]:
    """Return the kind of a captured value, and its content."""
    return next(iter(node.items()))


@dataclass(frozen=True)
class Initial:
    """
    What was there when training began.

    :param attributes: what was captured of those that can be left out, by path
    :param shared: the arrays that were parts of the same memory, each group as one text: how they are reached
    :param texts: all texts by path, since some of them are locations
    """

    attributes: dict[str, Any]
    shared: dict[str, str]
    texts: dict[str, str]


class Capture:
    """
    One walk through object graphs that may share objects.

    :param kinds: how each kind of value is captured, in the order in which they are tried
    :param known: objects that are captured elsewhere, by name
    :param initial: of the capture of the objects as they were built; None for that capture itself
    """

    def __init__(self, kinds: "Kinds", known: dict[str, Any] | None = None, initial: Initial | None = None):
        self.kinds = kinds
        self.arrays: list[np.ndarray] = []
        self.left_out: list[str] = []
        self.attributes: dict[str, Any] = {}
        self.texts: dict[str, str] = {}  # those that the objects were built with
        self.first_arrays: dict[str, int] = {}  # of attributes that are captured separately
        self.shared_elsewhere: dict[str, str] = {}  # memory, in such captures
        self.owners: list[Any] = []  # of memory that is captured with an object: arrays in it need no numbers
        self.initial = initial
        self._known = {id(value): name for name, value in (known or {}).items()}
        self._seen: dict[int, int] = {}
        self._alive: list[Any] = []
        self._memory: dict[int, int] = {}
        self._new_memory = itertools.count()
        self._parts: list[tuple[int, str, str]] = []  # the memory of every array, its path, and how it is reached
        self._trail: list[str] = []  # the classes of the values under way

    def capture(self, value: Any, path: str) -> Any:
        """
        Capture a value.

        :return: JSON
        :raises NotCapturedError: for what cannot be captured
        """
        if is_scalar(value):
            if type(value) is str and self.initial is None:
                self.texts[path] = value
            return value
        if id(value) in self._known:
            return {"known": self._known[id(value)]}
        if id(value) in self._seen:
            return {"same": self._seen[id(value)]}
        if len(self._trail) == _DEEPEST:
            raise NotCapturedError(f"{path} is nested more than {_DEEPEST} deep")
        tag = next((tag for tag, kind in self.kinds.items() if kind.matches(value)), None)
        if tag is None:
            raise NotCapturedError(f"{path} is a {name_of(type(value))}")
        self._trail.append(name_of(type(value)))
        try:
            kind = self.kinds[tag]
            if not kind.has_identity:
                return {tag: kind.capture(self, value, path)}
            number = self._seen[id(value)] = len(self._alive)
            self._alive.append(value)
            return {tag: kind.capture(self, value, path), "id": number}
        finally:
            self._trail.pop()

    def capture_attributes(self, values: dict[str, Any], path: str, optional: bool = False) -> dict[str, Any]:
        """
        Capture values by name.

        :param optional: leave out, and note, what cannot be captured or will not be restored
        """
        if not optional:
            return {name: self.capture(value, f"{path}.{name}") for name, value in values.items()}
        captured = {}
        for name, value in values.items():
            node = self.capture_optional(value, f"{path}.{name}")
            if node is not MISSING:
                captured[name] = node
        return captured

    def capture_optional(self, value: Any, path: str) -> Any:
        """Return JSON, or MISSING for what cannot be captured or will not be restored."""
        mark = self.mark()
        try:
            node = self.capture(value, path)
            if self.initial is not None:
                for why in uncovered(self.kinds, node, self.initial.attributes.get(path), path):
                    raise NotCapturedError(why)
        except OSError:  # a full disk
            raise
        except Exception as error:
            is_named = isinstance(error, NotCapturedError)
            self.left_out.append(str(error) if is_named else f"{path} ({type(error).__name__}: {error})")
            self.return_to(mark)
            return MISSING
        self.attributes[path] = node
        return node

    def mark(self) -> Any:
        """Return what :meth:`return_to` takes."""
        return [len(each) for each in self._lists()], dict(self._seen), dict(self.attributes)

    def return_to(self, mark: Any) -> None:
        """Forget what has been captured since: it will not be in the state, nor may it be referred to."""
        lengths, self._seen, self.attributes = mark
        for each, length in zip(self._lists(), lengths, strict=True):
            del each[length:]

    def _lists(self) -> tuple[list[Any], ...]:
        return self.arrays, self._parts, self.owners

    def add_array(self, array: np.ndarray) -> dict[str, int]:
        """Return what stands for it in JSON."""
        self.arrays.append(array)
        return {"#": len(self.arrays) - 1}

    def note_memory(self, address: int | None, path: str, part: Any) -> int:
        """
        Note the memory that an array is a part of.

        :param part: which part of the memory it is, and of which shape and type
        :param address: where the memory begins that an array is a part of; None if it has no numbers
        :return: the number of this memory
        """
        new = next(self._new_memory)
        number = new if address is None else self._memory.setdefault(address, new)
        self._parts.append((number, path, f"{path} {part} {' '.join(self._trail)}"))
        return number

    def as_initial(self) -> Initial:
        """Return what later captures are compared with."""
        return Initial(self.attributes, self.shared_memory(), self.texts)

    def tell_shared_memory(self) -> None:
        """Note what shares its memory and did not when training began: it will not when the run is resumed."""
        if self.initial is not None:
            new = [paths for group, paths in self.shared_memory().items() if group not in self.initial.shared]
            self.left_out += [f"{paths} share their memory, and did not so when training began" for paths in new]

    def shared_memory(self) -> dict[str, str]:
        """Return the paths of arrays that are parts of the same memory, by how they are reached."""
        groups: dict[int, list[tuple[str, str]]] = {}
        for number, path, way in self._parts:
            groups.setdefault(number, []).append((way, path))
        shared = [sorted(group) for group in groups.values() if len(group) > 1]
        return self.shared_elsewhere | {
            "\n".join(way for way, _ in group): " and ".join(path for _, path in group) for group in shared
        }


class Restore:
    """
    The walk back.

    :param kinds: of the :class:`Capture`
    :param arrays: of the :class:`Capture`
    :param known: as there
    :param step: the timestep of the capture
    :param with_files: restore files too
    :param locations: where the run's files were, and are now
    """

    def __init__(
        self,
        kinds: "Kinds",
        arrays: list[np.ndarray],
        known: dict[str, Any] | None = None,
        step: int = 0,
        with_files: bool = True,
        locations: Locations = UNMOVED,
    ):
        self.kinds = kinds
        self.known, self.step, self.with_files, self.locations = known or {}, step, with_files, locations
        self.restarted: list[str] = []
        self.not_restored: list[str] = []
        self._arrays = arrays
        self._seen: dict[int, Any] = {}
        self._numbers: list[int | None] = []  # of the values under way
        self._claimed: dict[int, Any] = {}
        self._whole: dict[int, Any] = {}
        self._memory: dict[int, int] = {}

    def restore(self, node: Any, existing: Any, path: str) -> Any:
        """
        Restore a value.

        :param node: what was captured
        :param existing: what is there now; it becomes the value where it can, for all that refer to it
        :return: the value
        :raises NotRestoredError: if it does not fit
        """
        if not isinstance(node, dict):
            node = self.locations.find(node, existing, path) if type(node) is str else node
            return existing if _is_same_scalar(existing, node) else node
        tag, content = head(node)
        if tag == "known":
            return self.known[content]
        if tag == "same":
            if content not in self._seen:
                raise NotRestoredError(f"{path} was part of what could not be restored")
            return self._seen[content]
        self._numbers.append(node.get("id"))
        value = self.kinds[tag].restore(self, content, existing, path)
        self.begin(value)
        self._numbers.pop()
        self._whole[id(value)] = value  # alive, so that its id stays its own
        return value

    def has_restored(self, value: Any) -> bool:
        """Return whether an object has got back all of its state."""
        return id(value) in self._whole

    @contextmanager
    def names(self) -> Iterator[None]:
        """Restore texts that are looked up: keys of dictionaries, columns of logs."""
        locations, self.locations = self.locations, self.locations.of_names()
        try:
            yield
        finally:
            self.locations = locations

    def begin(self, value: Any) -> None:
        """Register a value before its contents are restored: they may refer to it."""
        if self._numbers[-1] is not None:
            self._seen[self._numbers[-1]] = value

    def claims(self, existing: Any) -> bool:
        """Return whether an existing object may become a value: not if it has become another value already."""
        is_free = existing is not MISSING and id(existing) not in self._claimed
        if is_free:
            self._claimed[id(existing)] = existing  # alive, as above
        return is_free

    def claims_memory(self, memory: int, there: int) -> bool:
        """Return whether existing memory may become that of captured arrays: not if it has become another already."""
        return self._memory.setdefault(there, memory) == memory

    def restore_attributes(self, nodes: dict[str, Any], owner: Any, path: str, optional: bool = False) -> None:
        """
        Set the attributes of an object.

        :param optional: leave an attribute that cannot be restored as it is, and note it
        """
        for name, node in nodes.items():
            existing = attributes_of(owner).get(name, MISSING)
            with self.optional(f"{path}.{name}") if optional else nullcontext():
                value = self.restore(node, existing, f"{path}.{name}")
                if value is not existing:
                    object.__setattr__(owner, name, value)

    @contextmanager
    def optional(self, path: str) -> Iterator[None]:
        """Leave what cannot be restored in this block as it is, and note it."""
        depth = len(self._numbers)
        try:
            yield
        except Exception as error:
            del self._numbers[depth:]
            is_named = isinstance(error, NotRestoredError)
            self.not_restored.append(str(error) if is_named else f"{path} ({type(error).__name__}: {error})")

    def array(self, content: dict[str, int]) -> np.ndarray:
        """Return the array that a content stands for, to be copied."""
        return self._arrays[content["#"]]


def no_children(content: Any) -> dict[str, Any]:
    """Return no children, for values without parts."""
    return {}


class Kind:
    """
    How one kind of value is captured and restored.

    :param needs: what has to be there to restore a content, as a text; None if it is made from the content alone
    :param children: the values inside a content, by the rest of their paths
    :param has_identity: whether it matters if two of these are one
    """

    def __init__(
        self,
        matches: Callable[[Any], bool],
        capture: Callable[[Capture, Any, str], Any],
        restore: Callable[[Restore, Any, Any, str], Any],
        has_identity: bool = True,
        needs: Callable[[Any], str | None] = lambda content: None,
        children: Callable[[Any], dict[str, Any]] = no_children,
    ):
        self.matches, self.capture, self.restore, self.has_identity = matches, capture, restore, has_identity
        self.needs, self.children = needs, children


def plain(
    matches: Callable[[Any], bool],
    capture: Callable[[Any], dict[str, Any]],
    restore: Callable[[Any, Any], Any],
    needs: Callable[[Any], str | None] = lambda content: None,
    owner: Callable[[Any], Any] | None = None,
) -> Kind:
    """
    Return a kind whose state is a dict of plain values.

    :param restore: takes the existing value (MISSING if it has become another one) and this dict, returns the value
    :param owner: takes the value, returns what arrays have as their base that are views of its memory
    """

    def capture_content(context: Capture, value: Any, path: str) -> Any:
        if owner is not None:
            context.owners.append(owner(value))
        return context.capture_attributes(capture(value), path)

    def restore_content(context: Restore, content: Any, existing: Any, path: str) -> Any:
        state = {name: context.restore(node, MISSING, f"{path}.{name}") for name, node in content.items()}
        return restore(existing if context.claims(existing) else MISSING, state)

    return Kind(matches, capture_content, restore_content, needs=needs)


def uncovered(kinds: "Kinds", node: Any, initial: Any, path: str) -> Iterator[str]:
    """
    Yield what of a captured value cannot be restored into the objects that were there when training began.

    :param node: the value
    :param initial: what was captured at that time in its place
    :return: sentences that begin with a path
    """
    if not isinstance(node, dict) or head(node)[0] in ("known", "same"):
        return
    tag, content = head(node)
    there = head(initial)[1] if isinstance(initial, dict) and head(initial)[0] == tag else MISSING
    kind = kinds[tag]
    needs = kind.needs(content)
    if needs is not None and (there is MISSING or kind.needs(there) != needs):
        yield f"{path} is {needs}, which was not there when training began"
        return
    initially = {} if there is MISSING else kind.children(there)
    for name, child in kind.children(content).items():
        yield from uncovered(kinds, child, initially.get(name), path + name)


def existing_as(kind: Any, existing: Any, path: str) -> Any:
    """
    Check the class of an existing object.

    :raises NotRestoredError: unless the existing object is of the class
    """
    if not isinstance(existing, kind):
        found = "nothing" if existing is MISSING else f"a {name_of(type(existing))}"
        raise NotRestoredError(f"{path} was a {name_of(kind)}, and is {found}")
    return existing


# By tag, in the order in which they are tried: the first that matches counts
Kinds = Mapping[str, Kind]


def name_of(kind: Any) -> str:
    """Return the name of a class or function, with its module."""
    return f"{getattr(kind, '__module__', '')}.{getattr(kind, '__qualname__', kind)}"


# Attributes that are set by SB3 when training begins, or are whose state is captured elsewhere
_SKIPPED: dict[type, set[str]] = {
    BaseCallback: {"model", "locals", "globals", "parent"},
    VecEnvWrapper: {"class_attributes"},
    gym.Wrapper: {"_cached_spec"},
    nn.RNNBase: {"_flat_weight_refs"},
}


def attributes_of(value: Any) -> dict[str, Any]:
    """Return all attributes of an object, those in slots too, by name."""
    skipped = {name for kind, names in _SKIPPED.items() if isinstance(value, kind) for name in names}
    slots = [name for c in type(value).__mro__ for name, v in vars(c).items() if is_slot(v)]
    attributes = {name: getattr(value, name) for name in slots if hasattr(value, name)}
    attributes.update(getattr(value, "__dict__", {}))
    return {name: item for name, item in attributes.items() if name not in skipped}


def is_slot(value: Any) -> bool:
    """Return whether an attribute of a class is a slot of its objects."""
    return isinstance(value, types.MemberDescriptorType)
