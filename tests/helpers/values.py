"""Values of every kind, built from recipes, and a comparison that is independent of the code under test."""

import collections
import ctypes
import dataclasses
import enum
import functools
import mmap
import pathlib
import random
import threading
import types
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch as th


class Colour(enum.Enum):
    RED = 1
    BLUE = 2


class Pair(NamedTuple):
    a: Any
    b: Any


@dataclasses.dataclass
class Record:
    item: Any = 0


class Node:
    def __init__(self, item=None):
        self.item = item

    def method(self):
        return self.item

    def other_method(self):
        return None


class Names(dict):
    """A dictionary of a custom class."""


def counter(start=0):
    count = start

    def count_on():
        nonlocal count
        count += 1
        return count

    return count_on


def local_tuple():
    class Local(NamedTuple):
        a: int

    return Local


LOCAL = local_tuple()  # in no module under this name


def with_gradient():
    tensor = th.ones(2, requires_grad=True)
    (3 * tensor).sum().backward()
    return tensor


def optimizer():
    module = th.nn.Linear(2, 1)
    adam = th.optim.Adam(module.parameters(), lr=0.1)
    module(th.ones(2)).sum().backward()
    adam.step()
    return [module, adam]


def cyclic():
    inside: list[Any] = [1]
    inside.append({"back": inside})
    return inside


class Lends:
    """An object whose memory NumPy reaches through the array interface, as that of many libraries."""

    def __init__(self, numbers):
        self.array = np.array(numbers)
        self.__array_interface__ = self.array.__array_interface__


def lent_by_ctypes(numbers):
    memory: Any = (ctypes.c_double * len(numbers))(*numbers)
    return np.frombuffer(memory)


def lent_by_mmap(numbers):
    memory = mmap.mmap(-1, 8 * len(numbers))
    memory[:] = np.array(numbers).tobytes()
    return np.frombuffer(memory)


@functools.cache  # compiling takes longer than everything else in a test
def _compiled_copy():
    return pytest.importorskip("numba").njit(lambda array: array + 0.0)


def lent_by_numba(numbers):
    return _compiled_copy()(np.array(numbers))


LENT = [lent_by_ctypes, lent_by_mmap, lent_by_numba, lambda numbers: np.asarray(Lends(numbers))]


# Functions that build the value anew at every call
LEAVES: dict[str, Any] = {
    **{repr(v): (lambda v=v: v) for v in (None, True, False, 0, -1, 1.5, -0.0, np.inf, "", "text", b"", b"\0\xff")},
    "nan": lambda: float("nan"),
    "a large integer": lambda: 10**5000,
    "surrogates": lambda: "\ud800\udc00",
    "complex": lambda: complex(-0.0, 2),
    "range": lambda: range(3, 9, 2),
    "path": lambda: pathlib.Path("a/b"),
    "other path": lambda: pathlib.Path("/c"),
    "numpy's type": lambda: np.dtype(">f4"),
    "torch's type": lambda: th.bfloat16,
    "device": lambda: th.device("cpu"),
    "float32": lambda: np.float32(0.1),
    "numpy's text": lambda: np.str_("a\0"),
    "time": lambda: np.datetime64("2001-02-03"),
    "array": lambda: np.arange(6.0).reshape(2, 3),
    "other array": lambda: -np.arange(6.0).reshape(2, 3),
    "int array": lambda: np.arange(3, dtype=np.int8),
    "empty array": lambda: np.zeros((0, 2)),
    "long array": lambda: np.repeat(np.arange(5), 2000),
    "structured": lambda: np.array([(1, 2.0)], dtype=[("a", "i4"), ("b", "f8")]),
    "objects in an array": lambda: np.array([None, [1, 2]], dtype=object),
    "masked": lambda: np.ma.masked_array([1, 2], [0, 1]),
    "views": lambda: [(whole := np.arange(10.0)), whole[2:5], whole[::-1]],
    "shifted views": lambda: [(whole := np.arange(10.0)), whole[3:6], whole[::-1]],
    "no views": lambda: [np.arange(10.0), np.arange(3.0), np.arange(10.0)],
    "other arrays of these shapes": lambda: [np.ones(10), np.arange(20.0)[2:5], np.arange(10.0)[::-1]],
    "long floats": lambda: [0.5] * 70,
    "long integers": lambda: [2**70, -1] * 40,
    "long unsigned": lambda: [2**63, -1] * 40,
    "tensor": lambda: th.arange(3.0),
    "tensor and array": lambda: [(array := np.arange(4.0)), th.from_numpy(array)],
    "parameter": lambda: th.nn.Parameter(th.ones(2), requires_grad=False),
    "tensor with a gradient": with_gradient,
    "tensor with a history": lambda: th.ones(1, requires_grad=True) * 2,
    "half": lambda: th.ones(2, dtype=th.bfloat16),
    "module": lambda: th.nn.Sequential(th.nn.Linear(1, 2), th.nn.BatchNorm1d(2)).eval(),
    "optimizer": optimizer,
    "generator": lambda: np.random.default_rng(1),
    "other generator": lambda: np.random.default_rng(2),
    "spawned": lambda: (generator := np.random.default_rng(1), generator.spawn(2))[0],
    "random state": lambda: np.random.RandomState(1),
    "python's random": lambda: random.Random(1),
    "system's random": random.SystemRandom,
    "red": lambda: Colour.RED,
    "blue": lambda: Colour.BLUE,
    "local tuple": lambda: LOCAL(1),
    "record": lambda: Record([1]),
    "simple namespace": lambda: types.SimpleNamespace(a=1),
    "int": lambda: int,
    "len": lambda: len,
    "max": lambda: max,
    "numpy": lambda: np,
    "torch": lambda: th,
    "add": lambda: np.add,
    "multiply": lambda: np.multiply,
    "mean": lambda: np.mean,
    "list of int": lambda: list[int],
    "list of str": lambda: list[str],
    "a lambda": lambda: lambda x: x + 1,
    "another lambda": lambda: lambda x: x - 1,
    "a default": lambda: lambda x=1: x,
    "another default": lambda: lambda x=2: x,
    "counter": counter,
    "other counter": lambda: counter(7),
    "method": lambda: Node(1).method,
    "other method": lambda: Node(1).other_method,
    "partial": lambda: functools.partial(max, 1),
    "other partial": lambda: functools.partial(max, 2),
    "nan as a key": lambda: {float("nan"): 1},
    "nan in a set": lambda: {float("nan")},
    "enum keys": lambda: {Colour.RED: [1], Colour.BLUE: Node(2)},
    "path keys": lambda: {pathlib.Path("a"): 1, pathlib.Path("b"): 2},
    "object keys": lambda: {Node(1): 2},
    "function keys": lambda: {len: 1},
    "missing lists": lambda: collections.defaultdict(list, a=[1]),
    "missing counters": lambda: collections.defaultdict(counter, a=1),
    "counted": lambda: collections.Counter("abca"),
    "names": lambda: Names(a=1),
    "cyclic": cyclic,
    "deep": lambda: functools.reduce(lambda inside, _: [inside], range(150), list[Any]()),
    "lock": threading.Lock,
    "iterator": lambda: iter([1]),
}  # fmt: skip
BOXES: dict[str, Any] = {
    "list": list,
    "tuple": tuple,
    "pair": lambda items: Pair(items[:1], items[1:]),
    "dict": lambda items: {f"key {i}": item for i, item in enumerate(items)},
    "ordered": lambda items: collections.OrderedDict((i, item) for i, item in enumerate(items)),
    "deque": lambda items: collections.deque(items, maxlen=5),
    "node": Node,
    "record": Record,
    "objects": lambda items: _object_array(items),
}


def _object_array(items):
    array = np.empty(len(items), dtype=object)
    for i, item in enumerate(items):
        array[i] = item
    return array


def build(recipe: Any, built: list[Any] | None = None) -> Any:
    """
    Build the value of a recipe.

    :param recipe: name of a leaf, or ("same", number) of a value built before, or (box, recipes)
    """
    built = [] if built is None else built
    if isinstance(recipe, str):
        value = LEAVES[recipe]()
    elif recipe[0] == "same":
        return built[recipe[1] % len(built)] if built else None
    else:
        value = BOXES[recipe[0]]([build(part, built) for part in recipe[1]])
    built.append(value)
    return value


def alike(a: Any, b: Any) -> bool:
    """Return whether two graphs of objects have the same classes and values, and share objects and memory alike."""
    arrays: list[tuple[Any, Any]] = []
    result = _alike(a, b, {}, {}, arrays)
    for i, (x, y) in enumerate(arrays):
        result = result and all(np.shares_memory(x, u) == np.shares_memory(y, v) for u, v in arrays[:i])
    return result


def _alike(a: Any, b: Any, there: dict[int, Any], back: dict[int, Any], arrays: list[Any]) -> bool:
    if type(a) is not type(b):
        return False
    if isinstance(a, (types.ModuleType, type, np.ufunc, types.BuiltinFunctionType, enum.Enum)) or a is np.mean:
        return a is b
    if isinstance(a, int):
        return a == b
    if a is None or isinstance(a, (float, complex, str, bytes, range, pathlib.PurePath, th.dtype, th.device)):
        return repr(a) == repr(b)
    if isinstance(a, (np.dtype, np.generic, types.GenericAlias)):
        return a == b and repr(a) == repr(b)

    def same(x: Any, y: Any) -> bool:
        return _alike(x, y, there, back, arrays)

    if not isinstance(a, (tuple, frozenset, types.MethodType)):  # objects whose identity matters
        if id(a) in there or id(b) in back:
            return there.get(id(a)) is b and back.get(id(b)) is a
        there[id(a)], back[id(b)] = b, a
    return _same_content(a, b, same, arrays)


def _same_content(a: Any, b: Any, same: Any, arrays: list[Any]) -> bool:
    if isinstance(a, np.ndarray) and type(a) is np.ndarray:
        arrays.append((a, b))
        if a.dtype == object:
            return a.shape == b.shape and all(map(same, a.flat, b.flat))
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, th.Tensor):
        if a.dtype == th.bfloat16 or a.grad_fn is not None:
            return a is b
        arrays.append((a.detach().numpy(), b.detach().numpy()))
        equal = a.dtype == b.dtype and a.shape == b.shape and a.requires_grad == b.requires_grad
        return equal and bool((a.detach() == b.detach()).all()) and same(a.grad, b.grad)
    if isinstance(a, th.optim.Optimizer):
        return same(a.state_dict(), b.state_dict())
    if isinstance(a, np.random.Generator):
        spawned = (a.bit_generator.seed_seq.n_children_spawned, b.bit_generator.seed_seq.n_children_spawned)
        return a.bit_generator.state == b.bit_generator.state and spawned[0] == spawned[1]
    if isinstance(a, np.random.RandomState):
        return same(a.get_state(), b.get_state())
    if type(a) is random.Random:
        return a.getstate() == b.getstate()
    if isinstance(a, dict):
        extra = [vars(a), vars(b)] if type(a) is Names else [{}, {}]
        factories = getattr(a, "default_factory", None), getattr(b, "default_factory", None)
        keys = len(a) == len(b) and all(map(same, a, b))
        return keys and all(map(same, a.values(), b.values())) and same(*factories) and extra[0] == extra[1]
    if isinstance(a, (set, frozenset)):
        return len(a) == len(b) and all(map(same, sorted(a, key=repr), sorted(b, key=repr)))
    if isinstance(a, (list, tuple, collections.deque)):
        return len(a) == len(b) and getattr(a, "maxlen", 0) == getattr(b, "maxlen", 0) and all(map(same, a, b))
    if isinstance(a, types.FunctionType):
        cells = ([c.cell_contents for c in f.__closure__ or ()] for f in (a, b))
        code = a.__code__.co_code == b.__code__.co_code and a.__code__.co_consts == b.__code__.co_consts
        return code and same(*cells) and same(a.__defaults__, b.__defaults__)
    if isinstance(a, types.MethodType):
        return a.__func__ is b.__func__ and same(a.__self__, b.__self__)
    if isinstance(a, functools.partial):
        return same([a.func, a.args, a.keywords], [b.func, b.args, b.keywords])
    if type(a) in (Node, Record, *(type(m) for m in (th.nn.Linear(1, 1), th.nn.Sequential(), th.nn.BatchNorm1d(1)))):
        return same(vars(a), vars(b))
    return a is b  # a lock, an iterator, and the like
