"""
Read a pickle without running it.

What a pickle would import comes back as a :class:`Name`, and what it would call as a :class:`Call`: records, which
:func:`rebuild` turns into objects only where the caller knows them. No module is imported, no class is looked up, and
Python's unpickler is not used.
"""

import pickletools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import IO, Any, NamedTuple, TypeAlias

# Far above what SB3 writes for a model; below what could stall the reader
MAX_OPCODES = 10_000_000
MAX_DEPTH = 64
MAX_INTEGER_BITS = 128  # numpy's generators have states of that size


class UnsafeFileError(ValueError):
    """A file that is not opened, with the reason in one sentence: it asks for more than data, or it is damaged."""


class Name(NamedTuple):
    """What a pickle would import."""

    module: str
    attribute: str

    def __str__(self) -> str:
        return f"{self.module}.{self.attribute}"[:200]


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
Rebuild: TypeAlias = Callable[[Any], Any]

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
_SCALARS = (str, bytes, int, float, bool, type(None))  # what a key may be: cheap to hash, whatever the file says


def read_pickle(data: bytes | IO[bytes]) -> Any:
    """
    :param data: a pickle of protocol 2 or later, or a file whose ``read(n)`` makes nothing larger than what is left
    :return: numbers, texts, bytes, tuples, lists, dicts and sets of these; :class:`Name`; :class:`Call`
    :raises UnsafeFileError: if it is damaged, or is more than data, names and calls
    """
    try:
        return _run(data)
    except UnsafeFileError:
        raise
    except (ValueError, IndexError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise UnsafeFileError("a damaged pickle") from error


def _run(data: bytes | IO[bytes]) -> Any:
    """The pickle machine, in which importing and calling are only noted down."""
    stack: list[Any] = []
    marks: list[list[Any]] = []  # the stacks below each MARK
    memo: dict[int, Any] = {}

    def pop_mark() -> list[Any]:
        nonlocal stack
        items, stack = stack, marks.pop()
        return items

    argument: Any
    for count, (opcode, argument, _) in enumerate(pickletools.genops(data)):
        name = opcode.name
        if count > MAX_OPCODES:
            raise UnsafeFileError(f"a pickle of more than {MAX_OPCODES:,} operations")
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
            if not all(isinstance(item, _SCALARS) for item in items):
                raise UnsafeFileError("a set of more than numbers and texts")
            stack[-1].update(items) if name == "ADDITEMS" else stack.append(set(items))
        elif name == "GLOBAL":
            stack.append(Name(*argument.split(" ", 1)))
        elif name == "STACK_GLOBAL":
            attribute, module = stack.pop(), stack.pop()
            if not (isinstance(module, str) and isinstance(attribute, str)):
                raise UnsafeFileError("an import of something that is not a name")
            stack.append(Name(module, attribute))
        elif name in _CALLS:
            args, function = stack.pop(), stack.pop()
            stack.append(Call(function, args))
        elif name == "BINPERSID":
            stack.append(Call(PERSISTENT, stack.pop()))
        elif name == "BUILD":
            state = stack.pop()
            stack[-1].state = state  # of a Call; anything else has no such attribute
        elif name == "STOP":
            return stack.pop()
        elif name not in ("PROTO", "FRAME"):
            raise UnsafeFileError(f"a pickle with the operation {name}")
    raise UnsafeFileError("a truncated pickle")


def _last(stack: list[Any], n: int) -> list[Any]:
    if len(stack) < n:
        raise IndexError
    return stack[-n:]


def _set_items(target: Any, items: list[Any]) -> None:
    pairs = list(zip(items[::2], items[1::2], strict=True))
    if not all(isinstance(key, _SCALARS) for key, _ in pairs):
        raise UnsafeFileError("a mapping with keys that are more than numbers and texts")
    if isinstance(target, Call):
        target.items.extend(pairs)
    elif isinstance(target, dict):
        target.update(pairs)
    else:
        raise TypeError


def rebuild(
    value: Any,
    classes: Mapping[Name, type],
    calls: Mapping[Name, Callable[[Call, Rebuild], Any]],
) -> Any:
    """
    Make objects of what :func:`read_pickle` returned.

    :param classes: what a name may stand for
    :param calls: what a call of a name makes; the function is given the record, and this function for its parts
    :raises UnsafeFileError: for any other name or call, by name
    """
    finished: dict[int, tuple[Any, Any]] = {}  # by identity (the part is kept alive): what is shared is rebuilt once
    under_way: set[int] = set()

    def make(part: Any) -> Any:
        if isinstance(part, (*_SCALARS, bytearray)):
            return part
        if id(part) in finished:
            return finished[id(part)][1]
        if id(part) in under_way or len(under_way) >= MAX_DEPTH:
            raise UnsafeFileError("data that contains itself, or is nested too deeply")
        under_way.add(id(part))
        try:
            result = _make(part, make, classes, calls)
        finally:
            under_way.discard(id(part))
        finished[id(part)] = (part, result)
        return result

    return make(value)


def _make(
    part: Any,
    make: Rebuild,
    classes: Mapping[Name, type],
    calls: Mapping[Name, Callable[[Call, Rebuild], Any]],
) -> Any:
    if isinstance(part, Name):
        if part not in classes:
            raise UnsafeFileError(f"a reference to {part}")
        return classes[part]
    if isinstance(part, Call):
        if not isinstance(part.function, Name):
            raise UnsafeFileError("a call of something that has no name")
        if part.function not in calls:
            raise UnsafeFileError(f"a call of {part.function}")
        return calls[part.function](part, make)
    if isinstance(part, dict):
        return {key: make(item) for key, item in part.items()}
    if isinstance(part, (list, tuple, set)):
        return type(part)(make(item) for item in part)
    raise UnsafeFileError(f"a {type(part).__name__}")
