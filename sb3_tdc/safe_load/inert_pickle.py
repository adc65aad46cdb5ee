"""
Reader of pickles that does not run them.

It returns a :class:`Name` for each object that a pickle would import, and a :class:`Call` for each call that it would
make. :class:`Rebuild` turns these records into objects, but only those that the caller knows. No module is imported, no
class is looked up, and Python's unpickler is not used.
"""

import pickletools
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass, field
from typing import IO, Any, NamedTuple

from sb3_tdc.common.untrusted import escaped
from sb3_tdc.safe_load.budget import Budget, UnsafeFileError

MAX_DEPTH = 64
MAX_INTEGER_BITS = 128  # the size of the states of numpy's generators


class Name(NamedTuple):
    """Record of an object that a pickle would import."""

    module: str
    attribute: str

    def __str__(self) -> str:
        return escaped(f"{self.module[:100]}.{self.attribute[:100]}")


@dataclass(eq=False)
class Call:
    """
    Record of a call that a pickle would make, ``function(*args)``, and of what it would then do to the result.

    :param state: the state that the result would be set to (``__setstate__``)
    :param items: the items that would be appended to the result
    :param pairs: the keys and values that would be set in the result; only their keys are known to be cheap to hash
    """

    function: Any
    args: Any
    state: Any = None
    items: list[Any] = field(default_factory=list)
    pairs: list[tuple[Any, Any]] = field(default_factory=list)


PERSISTENT = Name("pickle", "persistent_load")

_SCALARS = (str, bytes, int, float, bool, type(None))
LETTERS = 32  # of a text, beyond which it counts as more than one value
MAX_KEY = 2**32  # integers below it cannot be chosen so that their hashes collide


def read_pickle(data: bytes | IO[bytes], budget: Budget, noted: list[Name | Call] | None = None) -> Any:
    """
    Read a pickle without importing or calling anything.

    :param data: a pickle of protocol 2 or later, or a file object with one, whose ``read(n)`` must not allocate more
        bytes than the file has left
    :param budget: of the file that contains the pickle
    :param noted: a list that receives every name and call, including those that the returned value does not contain
    :return: numbers, texts, bytes, tuples, lists, dicts and sets of these; :class:`Name`; :class:`Call`
    :raises UnsafeFileError: if the pickle is damaged, or contains more than data, names and calls
    """
    try:
        return _Machine([] if noted is None else noted).run(data, budget)
    except UnsafeFileError:
        raise
    except (ValueError, IndexError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise UnsafeFileError("a damaged pickle") from error


class _Machine:
    """Pickle machine that only records imports and calls. Each operation takes the argument of its opcode."""

    def __init__(self, noted: list[Name | Call]):
        self.stack: list[Any] = []
        self.marks: list[list[Any]] = []  # the stacks below each MARK
        self.memo: dict[int, Any] = {}
        self.noted = noted

    def run(self, data: bytes | IO[bytes], budget: Budget) -> Any:
        """Return the value of a pickle."""
        for opcode, argument, _ in pickletools.genops(data):
            budget.take_opcode()
            if opcode.name == "STOP":
                return self.stack.pop()
            if opcode.name not in _OPERATIONS:
                raise UnsafeFileError(f"a pickle with the operation {opcode.name}")
            _OPERATIONS[opcode.name](self, argument)
        raise UnsafeFileError("a truncated pickle")

    # ---------------------------------------------------------------- values

    def push(self, value: Any) -> None:
        if isinstance(value, int) and value.bit_length() > MAX_INTEGER_BITS:
            raise UnsafeFileError(f"an integer of {value.bit_length():,} bits")
        self.stack.append(value)

    def pop(self, _: None) -> None:
        self.stack.pop()

    def ignore(self, _: Any) -> None:
        pass

    # ---------------------------------------------------------------- the memo

    def memoize(self, _: None) -> None:
        self.memo[len(self.memo)] = self.stack[-1]

    def put(self, index: int) -> None:
        self.memo[index] = self.stack[-1]

    def get(self, index: int) -> None:
        self.stack.append(self.memo[index])

    # ---------------------------------------------------------------- collections

    def mark(self, _: None) -> None:
        self.marks.append(self.stack)
        self.stack = []

    def _pop_mark(self) -> list[Any]:
        items, self.stack = self.stack, self.marks.pop()
        return items

    def make_tuple(self, _: None) -> None:
        items = self._pop_mark()
        self.stack.append(tuple(items))

    def make_list(self, _: None) -> None:
        items = self._pop_mark()
        self.stack.append(items)

    def make_dict(self, _: None) -> None:
        items = self._pop_mark()
        self.stack.append({})
        _set_items(self.stack[-1], items)

    def make_set(self, _: None) -> None:
        items = _checked_elements(self._pop_mark())
        self.stack.append(set(items))

    def append(self, _: None) -> None:
        item = self.stack.pop()
        self._extend([item])

    def append_marked(self, _: None) -> None:
        self._extend(self._pop_mark())

    def _extend(self, items: list[Any]) -> None:
        target = self.stack[-1]
        (target.items if isinstance(target, Call) else target).extend(items)

    def set_item(self, _: None) -> None:
        items = [self.stack.pop(-2), self.stack.pop()]
        _set_items(self.stack[-1], items)

    def set_marked_items(self, _: None) -> None:
        items = self._pop_mark()
        _set_items(self.stack[-1], items)

    def add_marked(self, _: None) -> None:
        items = _checked_elements(self._pop_mark())
        self.stack[-1].update(items)

    # ---------------------------------------------------------------- imports and calls, only recorded

    def _note(self, part: Name | Call) -> None:
        self.noted.append(part)
        self.stack.append(part)

    def import_name(self, argument: str) -> None:
        self._note(Name(*argument.split(" ", 1)))

    def import_from_stack(self, _: None) -> None:
        attribute, module = self.stack.pop(), self.stack.pop()
        if not (isinstance(module, str) and isinstance(attribute, str)):
            raise UnsafeFileError("an import of something that is not a name")
        self._note(Name(module, attribute))

    def call(self, _: None) -> None:
        args, function = self.stack.pop(), self.stack.pop()
        self._note(Call(function, args))

    def call_persistent_load(self, _: None) -> None:
        self._note(Call(PERSISTENT, self.stack.pop()))

    def build(self, _: None) -> None:
        state = self.stack.pop()
        if self.stack[-1].state is not None:  # if not a Call, an AttributeError: a damaged pickle
            raise UnsafeFileError("an object that is changed twice")
        self.stack[-1].state = state


def _pushing(make: Callable[[], Any]) -> Callable[[_Machine, None], None]:
    """Return the operation that pushes a new value."""
    return lambda machine, _: machine.stack.append(make())


def _making_tuple(n: int) -> Callable[[_Machine, None], None]:
    """Return the operation that makes a tuple of the last n values."""

    def operation(machine: _Machine, _: None) -> None:
        machine.stack[-n:] = [tuple(_last(machine.stack, n))]

    return operation


# All operations that a pickle may contain, except STOP
_OPERATIONS: dict[str, Callable[[_Machine, Any], None]] = {
    **dict.fromkeys(("PROTO", "FRAME"), _Machine.ignore),
    **dict.fromkeys(("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4"), _Machine.push),
    **dict.fromkeys(("FLOAT", "BINFLOAT"), _Machine.push),
    **dict.fromkeys(("UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"), _Machine.push),
    **dict.fromkeys(("BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"), _Machine.push),
    "NONE": _pushing(lambda: None),
    "NEWTRUE": _pushing(lambda: True),
    "NEWFALSE": _pushing(lambda: False),
    "EMPTY_TUPLE": _pushing(tuple),
    "EMPTY_LIST": _pushing(list),
    "EMPTY_DICT": _pushing(dict),
    "EMPTY_SET": _pushing(set),
    "POP": _Machine.pop,
    "MEMOIZE": _Machine.memoize,
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT"), _Machine.put),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), _Machine.get),
    "MARK": _Machine.mark,
    "TUPLE": _Machine.make_tuple,
    "TUPLE1": _making_tuple(1),
    "TUPLE2": _making_tuple(2),
    "TUPLE3": _making_tuple(3),
    "LIST": _Machine.make_list,
    "DICT": _Machine.make_dict,
    "FROZENSET": _Machine.make_set,
    "APPEND": _Machine.append,
    "APPENDS": _Machine.append_marked,
    "SETITEM": _Machine.set_item,
    "SETITEMS": _Machine.set_marked_items,
    "ADDITEMS": _Machine.add_marked,
    "GLOBAL": _Machine.import_name,
    "STACK_GLOBAL": _Machine.import_from_stack,
    **dict.fromkeys(("REDUCE", "NEWOBJ"), _Machine.call),
    "BINPERSID": _Machine.call_persistent_load,
    "BUILD": _Machine.build,
}


def _last(stack: list[Any], n: int) -> list[Any]:
    if len(stack) < n:
        raise IndexError
    return stack[-n:]


def _is_key(value: Any) -> bool:
    return isinstance(value, str | bool | None) or (isinstance(value, int) and abs(value) < MAX_KEY)


def _checked_elements(items: list[Any]) -> list[Any]:
    if not all(map(_is_key, items)):
        raise UnsafeFileError("a set of more than small integers and texts")
    return items


def _set_items(target: Any, items: list[Any]) -> None:
    pairs = list(zip(items[::2], items[1::2], strict=True))
    if not all(_is_key(key) for key, _ in pairs):
        raise UnsafeFileError("a mapping with keys that are more than small integers and texts")
    if isinstance(target, Call):
        target.pairs.extend(pairs)
    elif isinstance(target, dict):
        target.update(pairs)
    else:
        raise TypeError


class Rebuild:
    """
    Builder of objects from the records that :func:`read_pickle` returns.

    :param classes: the class that each known name stands for
    :param calls: the handler for calls of each known name
    :param budget: of the file. A shared value counts as often as it is reached, so that no text or array made from the
        result can be much larger than the file
    """

    def __init__(self, classes: "Mapping[Name, type]", calls: "Mapping[Name, Handler]", budget: Budget):
        self.classes, self.calls, self.budget = classes, calls, budget
        # By id: the part (kept alive, so that no other gets its id), its result, its number of nodes
        self._finished: dict[int, tuple[Any, Any, int]] = {}
        self._under_way: set[int] = set()
        self._nodes = 0

    def __call__(self, part: Any) -> Any:
        """
        Rebuild a part of a value.

        :param part: a value that :func:`read_pickle` returned, or a part of it
        :raises UnsafeFileError: if the part contains an unknown name or call; the error names it
        """
        if isinstance(part, (*_SCALARS, bytearray)):
            self._count(1 + len(part) // LETTERS if isinstance(part, str) else 1)
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

    def mapping(self, pairs: Mapping[Any, Any] | Iterable[tuple[Any, Any]]) -> dict[Any, Any]:
        """Rebuild the values of a mapping. Of its keys, which are plain, only long texts count."""
        items = dict(pairs)
        self._count(sum(len(key) // LETTERS for key in items if isinstance(key, str)))
        return {key: self(item) for key, item in items.items()}

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
            return self.mapping(part)
        if isinstance(part, (list, tuple, set)):
            return type(part)(self(item) for item in part)
        raise UnsafeFileError(f"a {type(part).__name__}")


@dataclass(frozen=True)
class Handler:
    """
    Handler for calls of a known name: it makes the object, and refuses calls with anything that it does not accept.

    :param make: makes the object from the record of the call and the :class:`Rebuild` for its parts
    :param args: the smallest and the largest number of arguments
    :param state: whether the object may be given a state
    :param pairs: whether the object may be given keys and values
    :param only: returns whether the arguments are accepted; called only if their number is allowed
    """

    make: Callable[[Call, Rebuild], Any]
    args: tuple[int, int] = (0, 0)
    state: bool = False
    pairs: bool = False
    only: Callable[..., bool] = lambda *_: True

    def __call__(self, call: Call, make: Rebuild) -> Any:
        if not self._takes_arguments(call):
            raise UnsafeFileError(f"a call of {call.function} with other arguments than it takes")
        if not self._takes_changes(call):
            raise UnsafeFileError(f"a {call.function} that is changed after it was made")
        return self.make(call, make)

    def takes(self, call: Call) -> bool:
        """Return whether the handler accepts a call: its arguments, and what is done to its result."""
        return self._takes_arguments(call) and self._takes_changes(call)

    def _takes_arguments(self, call: Call) -> bool:
        fewest, most = self.args
        return isinstance(call.args, tuple) and fewest <= len(call.args) <= most and self.only(*call.args)

    def _takes_changes(self, call: Call) -> bool:
        return (call.state is not None) <= self.state and bool(call.pairs) <= self.pairs and not call.items


def code_in(
    noted: Iterable[Name | Call], names: Container[Name], calls: Mapping[Name, Callable[[Call], bool]]
) -> list[str]:
    """
    List the unknown names that unpickling would import or call.

    :param noted: the names and calls that :func:`read_pickle` recorded
    :param names: the names that may be imported
    :param calls: the names that may also be called, each with a function that returns whether a call is allowed
    :return: the unknown names, sorted
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
