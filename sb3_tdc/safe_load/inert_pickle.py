"""
Read a pickle without running it.

What a pickle would import comes back as a :class:`Name`, and what it would call as a :class:`Call`: records, which
:class:`Rebuild` turns into objects only where the caller knows them. No module is imported, no class is looked up, and
Python's unpickler is not used.
"""

import pickletools
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass, field
from typing import IO, Any, NamedTuple

from sb3_tdc.common.untrusted import escaped
from sb3_tdc.safe_load.budget import Budget, UnsafeFileError

MAX_DEPTH = 64
MAX_INTEGER_BITS = 128  # numpy's generators have states of that size


class Name(NamedTuple):
    """What a pickle would import."""

    module: str
    attribute: str

    def __str__(self) -> str:
        return escaped(f"{self.module[:100]}.{self.attribute[:100]}")


@dataclass(eq=False)
class Call:
    """
    What a pickle would call, ``function(*args)``, and then do to the result.

    :param state: what it would be set to (``__setstate__``)
    :param items: what would be appended to it, or set in it as pairs
    """

    function: Any
    args: Any
    state: Any = None
    items: list[Any] = field(default_factory=list)


PERSISTENT = Name("pickle", "persistent_load")

_PUSHED = {
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT", "UNICODE", "BINUNICODE",
    "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8",
}  # fmt: skip
_CONSTANTS: dict[str, Any] = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_EMPTY: dict[str, Callable[[], Any]] = {"EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_SET": set}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_FROM_MARK: dict[str, Callable[[list[Any]], Any]] = {"TUPLE": tuple, "LIST": list}
_CALLS = {"REDUCE", "NEWOBJ"}
_PUT, _GET = {"PUT", "BINPUT", "LONG_BINPUT"}, {"GET", "BINGET", "LONG_BINGET"}
_SCALARS = (str, bytes, int, float, bool, type(None))
MAX_KEY = 2**32  # integers below it cannot be chosen so that their hashes collide


def read_pickle(data: bytes | IO[bytes], budget: Budget, noted: list[Name | Call] | None = None) -> Any:
    """
    Read a pickle without importing or calling anything.

    :param data: a pickle of protocol 2 or later, or a file whose ``read(n)`` makes nothing larger than what is left
    :param budget: of the file that it is in
    :param noted: gets every name and call, also those that the value does not hold in the end
    :return: numbers, texts, bytes, tuples, lists, dicts and sets of these; :class:`Name`; :class:`Call`
    :raises UnsafeFileError: if it is damaged, or is more than data, names and calls
    """
    try:
        return _run(data, budget, [] if noted is None else noted)
    except UnsafeFileError:
        raise
    except (ValueError, IndexError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise UnsafeFileError("a damaged pickle") from error


def _run(data: bytes | IO[bytes], budget: Budget, noted: list[Name | Call]) -> Any:
    """The pickle machine, in which importing and calling are only noted down."""
    stack: list[Any] = []
    marks: list[list[Any]] = []  # the stacks below each MARK
    memo: dict[int, Any] = {}

    def pop_mark() -> list[Any]:
        nonlocal stack
        items, stack = stack, marks.pop()
        return items

    def push_noted(part: Name | Call) -> None:
        noted.append(part)
        stack.append(part)

    argument: Any
    for opcode, argument, _ in pickletools.genops(data):
        name = opcode.name
        budget.take_opcode()
        if name in _PUSHED:
            if isinstance(argument, int) and argument.bit_length() > MAX_INTEGER_BITS:
                raise UnsafeFileError(f"an integer of {argument.bit_length():,} bits")
            stack.append(argument)
        elif name == "MEMOIZE":
            memo[len(memo)] = stack[-1]
        elif name in _PUT:
            memo[argument] = stack[-1]
        elif name in _GET:
            stack.append(memo[argument])
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name])
        elif name in _EMPTY:
            stack.append(_EMPTY[name]())
        elif name == "POP":
            stack.pop()
        elif name == "MARK":
            marks.append(stack)
            stack = []
        elif name in _FROM_MARK:
            items = pop_mark()
            stack.append(_FROM_MARK[name](items))
        elif name in _TUPLES:
            stack[-_TUPLES[name] :] = [tuple(_last(stack, _TUPLES[name]))]
        elif name == "DICT":
            items = pop_mark()
            stack.append({})
            _set_items(stack[-1], items)
        elif name in ("APPEND", "APPENDS"):
            items = pop_mark() if name == "APPENDS" else [stack.pop()]
            target = stack[-1]
            (target.items if isinstance(target, Call) else target).extend(items)
        elif name in ("SETITEM", "SETITEMS"):
            items = pop_mark() if name == "SETITEMS" else [stack.pop(-2), stack.pop()]
            _set_items(stack[-1], items)
        elif name in ("ADDITEMS", "FROZENSET"):
            items = pop_mark()
            if not all(map(_is_key, items)):
                raise UnsafeFileError("a set of more than small integers and texts")
            stack[-1].update(items) if name == "ADDITEMS" else stack.append(set(items))
        elif name == "GLOBAL":
            push_noted(Name(*argument.split(" ", 1)))
        elif name == "STACK_GLOBAL":
            attribute, module = stack.pop(), stack.pop()
            if not (isinstance(module, str) and isinstance(attribute, str)):
                raise UnsafeFileError("an import of something that is not a name")
            push_noted(Name(module, attribute))
        elif name in _CALLS:
            args, function = stack.pop(), stack.pop()
            push_noted(Call(function, args))
        elif name == "BINPERSID":
            push_noted(Call(PERSISTENT, stack.pop()))
        elif name == "BUILD":
            state = stack.pop()
            if stack[-1].state is not None:  # of a Call; anything else has no such attribute
                raise UnsafeFileError("an object that is changed twice")
            stack[-1].state = state
        elif name == "STOP":
            return stack.pop()
        elif name not in ("PROTO", "FRAME"):
            raise UnsafeFileError(f"a pickle with the operation {name}")
    raise UnsafeFileError("a truncated pickle")


def _last(stack: list[Any], n: int) -> list[Any]:
    if len(stack) < n:
        raise IndexError
    return stack[-n:]


def _is_key(value: Any) -> bool:
    return isinstance(value, str | bool | None) or (isinstance(value, int) and abs(value) < MAX_KEY)


def _set_items(target: Any, items: list[Any]) -> None:
    pairs = list(zip(items[::2], items[1::2], strict=True))
    if not all(_is_key(key) for key, _ in pairs):
        raise UnsafeFileError("a mapping with keys that are more than small integers and texts")
    if isinstance(target, Call):
        target.items.extend(pairs)
    elif isinstance(target, dict):
        target.update(pairs)
    else:
        raise TypeError


class Rebuild:
    """
    Makes objects of what :func:`read_pickle` returned.

    :param classes: what a name may stand for
    :param calls: what a call of a name makes
    :param budget: of the file. What is shared counts as often as it is reached, so that no text or array made of the
        result can be much larger than the file
    """

    def __init__(self, classes: "Mapping[Name, type]", calls: "Mapping[Name, Handler]", budget: Budget):
        self.classes, self.calls, self.budget = classes, calls, budget
        self._finished: dict[int, tuple[Any, Any, int]] = {}  # by identity (the part is kept alive): rebuilt once
        self._under_way: set[int] = set()
        self._nodes = 0

    def __call__(self, part: Any) -> Any:
        """
        Rebuild a part of a value.

        :param part: of the value
        :raises UnsafeFileError: for a name or a call that is not known, by name
        """
        if isinstance(part, (*_SCALARS, bytearray)):
            self._count(1)
            return part
        if id(part) in self._finished:
            _, result, size = self._finished[id(part)]
            self._count(size)
            return result
        if id(part) in self._under_way or len(self._under_way) >= MAX_DEPTH:
            raise UnsafeFileError("data that contains itself, or is nested too deeply")
        self._under_way.add(id(part))
        before = self._nodes
        self._count(1)
        try:
            result = self._make(part)
        finally:
            self._under_way.discard(id(part))
        self._finished[id(part)] = (part, result, self._nodes - before)
        return result

    def _count(self, n: int) -> None:
        self._nodes += n
        self.budget.take_nodes(n)

    def _make(self, part: Any) -> Any:
        if isinstance(part, Name):
            if part not in self.classes:
                raise UnsafeFileError(f"a reference to {part}")
            return self.classes[part]
        if isinstance(part, Call):
            if not isinstance(part.function, Name):
                raise UnsafeFileError("a call of something that has no name")
            if part.function not in self.calls:
                raise UnsafeFileError(f"a call of {part.function}")
            return self.calls[part.function](part, self)
        if isinstance(part, dict):
            return {key: self(item) for key, item in part.items()}
        if isinstance(part, (list, tuple, set)):
            return type(part)(self(item) for item in part)
        raise UnsafeFileError(f"a {type(part).__name__}")


@dataclass(frozen=True)
class Handler:
    """
    What a call of a known name makes, and what of the call it takes. Anything else there refuses the file.

    :param make: given the record, and what makes objects of its parts
    :param args: how many arguments, the fewest and the most
    :param state: whether it takes one
    :param items: whether it takes any
    :param only: given so many arguments, whether it takes them
    """

    make: Callable[[Call, Rebuild], Any]
    args: tuple[int, int] = (0, 0)
    state: bool = False
    items: bool = False
    only: Callable[..., bool] = lambda *_: True

    def __call__(self, call: Call, make: Rebuild) -> Any:
        if not self._takes_arguments(call):
            raise UnsafeFileError(f"a call of {call.function} with other arguments than it takes")
        if not self._takes_changes(call):
            raise UnsafeFileError(f"a {call.function} that is changed after it was made")
        return self.make(call, make)

    def takes(self, call: Call) -> bool:
        """Return whether a call, and what is done to its result, is all that the known one takes."""
        return self._takes_arguments(call) and self._takes_changes(call)

    def _takes_arguments(self, call: Call) -> bool:
        fewest, most = self.args
        return isinstance(call.args, tuple) and fewest <= len(call.args) <= most and self.only(*call.args)

    def _takes_changes(self, call: Call) -> bool:
        return (call.state is not None) <= self.state and bool(call.items) <= self.items


def code_in(
    noted: Iterable[Name | Call], names: Container[Name], calls: Mapping[Name, Callable[[Call], bool]]
) -> list[str]:
    """
    List what unpickling would import or call that is not known.

    :param noted: by :func:`read_pickle`
    :param names: what may be imported
    :param calls: what may also be called, and whether it may be called so
    :return: names, sorted
    """
    found = set()
    for part in noted:
        if isinstance(part, Name):
            is_known, name = part in names or part in calls, str(part)
        elif isinstance(part.function, Name):
            is_known, name = part.function in calls and calls[part.function](part), str(part.function)
        else:
            is_known, name = False, "what another call returns"
        if not is_known:
            found.add(name)
    return sorted(found)
