"""
Conversion of the state of Python objects to JSON and arrays, and back into existing objects. Nothing is pickled.

``capture`` walks an object graph; ``restore`` walks the same graph, built again, and gives it the captured values. A
value that may have a state invisible to Python (a native object, a lock, a socket) is refused, by an error that names
its path: an object is captured completely or not at all. Some values are created from their captured content alone;
others (an object of a class, a function) must already exist. :func:`uncovered` names those that did not exist when
training began, and so will not exist when the run is resumed.
"""

import itertools
import types
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper
from torch import nn

from sb3_tdc.resume.locations import UNMOVED, Locations

MISSING: Any = object()
# Deeper nesting could be captured, but not restored within Python's recursion limit
_DEEPEST = 100


class NotCapturedError(TypeError):
    """An object whose state cannot be captured; the message names its path and its type."""


class NotRestoredError(ValueError):
    """A captured state that does not fit what was built; the message names the path."""


def is_scalar(value: Any) -> bool:
    """Return whether a value is unchanged after a round trip through JSON."""
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
    The objects that existed when training began, as they were captured then.

    :param attributes: the captured attributes, of those that may be left out, by path
    :param shared: the paths of each group of arrays that shared memory, by a text that says how they are reached
    :param texts: all texts by path, since some of them are locations of files
    """

    attributes: dict[str, Any]
    shared: dict[str, str]
    texts: dict[str, str]


class Capture:
    """
    One capture: a walk through object graphs that may share objects.

    :param kinds: the kinds of values, in the order in which they are tried
    :param known: objects that are captured elsewhere, by name
    :param initial: the initial capture, of the objects as they were built; None if this is that capture
    """

    def __init__(self, kinds: "Kinds", known: dict[str, Any] | None = None, initial: Initial | None = None):
        self.kinds = kinds
        self.arrays: list[np.ndarray] = []
        self.left_out: list[str] = []
        self.attributes: dict[str, Any] = {}
        self.texts: dict[str, str] = {}  # by path: those that the objects were built with
        self.first_arrays: dict[str, int] = {}  # by path: the first array of an attribute captured separately
        self.shared_elsewhere: dict[str, str] = {}  # the memory shared within separate captures
        self.owners: list[Any] = []  # of native memory that is not captured again with arrays that view it
        self.initial = initial
        self._known = {id(value): name for name, value in (known or {}).items()}
        self._seen: dict[int, int] = {}
        self._alive: list[Any] = []
        self._memory: dict[int, int] = {}
        self._new_memory = itertools.count()
        self._parts: list[tuple[int, str, str]] = []  # of every array: its memory, its path, and how it is reached
        self._trail: list[str] = []  # the classes of the values that are being captured

    def capture(self, value: Any, path: str) -> Any:
        """
        Capture a value.

        :return: the value as JSON
        :raises NotCapturedError: if the value, or a part of it, cannot be captured
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

        :param optional: leave out, and note, values that cannot be captured or will not be restored
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
        """Return a value as JSON, or note it and return MISSING if it cannot be captured or will not be restored."""
        mark = self.mark()
        try:
            node = self.capture(value, path)
            if self.initial is not None:
                for why in uncovered(self.kinds, node, self.initial.attributes.get(path), path):
                    raise NotCapturedError(why)
        except OSError:  # for instance a full disk: the whole state cannot be written
            raise
        except Exception as error:
            is_named = isinstance(error, NotCapturedError)
            self.left_out.append(str(error) if is_named else f"{path} ({type(error).__name__}: {error})")
            self.return_to(mark)
            return MISSING
        self.attributes[path] = node
        return node

    def mark(self) -> Any:
        """Return a mark of the present position, for :meth:`return_to`."""
        return [len(each) for each in self._lists()], dict(self._seen), dict(self.attributes)

    def return_to(self, mark: Any) -> None:
        """Discard the values captured since a mark: they will not be in the state, and nothing may refer to them."""
        lengths, self._seen, self.attributes = mark
        for each, length in zip(self._lists(), lengths, strict=True):
            del each[length:]

    def _lists(self) -> tuple[list[Any], ...]:
        return self.arrays, self._parts, self.owners

    def add_array(self, array: np.ndarray) -> dict[str, int]:
        """Add an array, and return the JSON that refers to it."""
        self.arrays.append(array)
        return {"#": len(self.arrays) - 1}

    def note_memory(self, address: int | None, path: str, part: Any) -> int:
        """
        Note the memory that an array is a part of.

        :param address: the address at which the memory begins; None if the array is empty
        :param path: the path of the array
        :param part: which part of the memory the array is, and its shape and dtype
        :return: the number of this memory
        """
        new = next(self._new_memory)
        number = new if address is None else self._memory.setdefault(address, new)
        self._parts.append((number, path, f"{path} {part} {' '.join(self._trail)}"))
        return number

    def as_initial(self) -> Initial:
        """Return this capture as the initial one, with which later captures are compared."""
        return Initial(self.attributes, self.shared_memory(), self.texts)

    def tell_shared_memory(self) -> None:
        """Note arrays that share memory, but did not when training began: they will not when the run is resumed."""
        if self.initial is not None:
            new = [paths for group, paths in self.shared_memory().items() if group not in self.initial.shared]
            self.left_out += [f"{paths} share their memory, and did not so when training began" for paths in new]

    def shared_memory(self) -> dict[str, str]:
        """Return the paths of each group of arrays that share memory, by how they are reached."""
        groups: dict[int, list[tuple[str, str]]] = {}
        for number, path, way in self._parts:
            groups.setdefault(number, []).append((way, path))
        shared = [sorted(group) for group in groups.values() if len(group) > 1]
        return self.shared_elsewhere | {
            "\n".join(way for way, _ in group): " and ".join(path for _, path in group) for group in shared
        }


class Restore:
    """
    The reverse of a :class:`Capture`: a walk that restores the captured values into object graphs.

    :param kinds: the kinds of values, as in the :class:`Capture`
    :param arrays: the arrays of the :class:`Capture`
    :param known: objects that are restored elsewhere, by the names in the :class:`Capture`
    :param step: the timestep of the capture
    :param with_files: restore files, too
    :param locations: where the run's files were, and where they are now
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
        self._numbers: list[int | None] = []  # ids of the values that are being restored
        self._claimed: dict[int, Any] = {}
        self._whole: dict[int, Any] = {}
        self._memory: dict[int, int] = {}

    def restore(self, node: Any, existing: Any, path: str) -> Any:
        """
        Restore a value.

        :param node: the captured value, as JSON
        :param existing: the object in its place now; it becomes the value if possible, for all objects that refer to it
        :return: the restored value
        :raises NotRestoredError: if the captured value does not fit the objects that exist now
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
        self._whole[id(value)] = value  # kept alive, so that no other object gets its id
        return value

    def has_restored(self, value: Any) -> bool:
        """Return whether an object has been restored."""
        return id(value) in self._whole

    @contextmanager
    def texts(self, locations: Locations) -> Iterator[None]:
        """Take the texts that are restored in this block for locations by another rule."""
        before, self.locations = self.locations, locations
        try:
            yield
        finally:
            self.locations = before

    def names(self) -> AbstractContextManager[None]:
        """Restore the texts in this block as names, not as relative paths: keys of dictionaries, columns of logs."""
        return self.texts(self.locations.of_names())

    def begin(self, value: Any) -> None:
        """Register a value before its contents are restored, since they may refer to it."""
        if self._numbers[-1] is not None:
            self._seen[self._numbers[-1]] = value

    def claims(self, existing: Any) -> bool:
        """Claim an existing object for a captured value; return whether it exists and has not been claimed before."""
        is_free = existing is not MISSING and id(existing) not in self._claimed
        if is_free:
            self._claimed[id(existing)] = existing  # kept alive, as above
        return is_free

    def claims_memory(self, memory: int, there: int) -> bool:
        """Claim existing memory for captured memory; return whether no other captured memory has claimed it before."""
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
        """Note an error in this block instead of raising it: the value that cannot be restored stays as it is."""
        depth = len(self._numbers)
        try:
            yield
        except Exception as error:
            del self._numbers[depth:]
            is_named = isinstance(error, NotRestoredError)
            self.not_restored.append(str(error) if is_named else f"{path} ({type(error).__name__}: {error})")

    def array(self, content: dict[str, int]) -> np.ndarray:
        """Return the array that a content refers to; callers copy it."""
        return self._arrays[content["#"]]


def no_children(content: Any) -> dict[str, Any]:
    """Return no children, for values without parts."""
    return {}


class Kind:
    """
    How one kind of value is captured and restored.

    :param matches: returns whether a value is of this kind
    :param capture: returns the content of a value, as JSON
    :param restore: returns the value, from its content and the existing value
    :param has_identity: whether it matters that two references are to the same value
    :param needs: returns what must exist to restore a content, as a text; None if the content alone is enough
    :param children: returns the values inside a content, by the rest of their paths
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

    :param restore: returns the value, from the existing value (MISSING if it has been claimed before) and this dict
    :param owner: returns the object that is the base of all arrays that are views of a value's memory
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
    Yield the parts of a captured value that cannot be restored into the objects that existed when training began.

    :param node: the captured value
    :param initial: the value in its place in the initial capture
    :return: a sentence for each part, beginning with its path
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
    Check the class of an existing object, and return the object.

    :raises NotRestoredError: if the object does not exist, or is not of the class
    """
    if not isinstance(existing, kind):
        found = "nothing" if existing is MISSING else f"a {name_of(type(existing))}"
        raise NotRestoredError(f"{path} was a {name_of(kind)}, and is {found}")
    return existing


# By tag, in the order in which they are tried: the first kind that matches is used
Kinds = Mapping[str, Kind]


def name_of(kind: Any) -> str:
    """Return the name of a class or function, with its module."""
    return f"{getattr(kind, '__module__', '')}.{getattr(kind, '__qualname__', kind)}"


# Attributes that SB3 sets when training begins, or whose state is captured elsewhere
_SKIPPED: dict[type, set[str]] = {
    BaseCallback: {"model", "locals", "globals", "parent"},
    VecEnvWrapper: {"class_attributes"},
    gym.Wrapper: {"_cached_spec"},
    nn.RNNBase: {"_flat_weight_refs"},
}


def attributes_of(value: Any) -> dict[str, Any]:
    """Return the attributes of an object by name, including those in slots."""
    skipped = {name for kind, names in _SKIPPED.items() if isinstance(value, kind) for name in names}
    slots = [name for c in type(value).__mro__ for name, v in vars(c).items() if is_slot(v)]
    attributes = {name: getattr(value, name) for name in slots if hasattr(value, name)}
    attributes.update(getattr(value, "__dict__", {}))
    return {name: item for name, item in attributes.items() if name not in skipped}


def is_slot(value: Any) -> bool:
    """Return whether an attribute of a class is a slot of its instances."""
    return isinstance(value, types.MemberDescriptorType)
