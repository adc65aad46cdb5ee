"""What each kind of value is captured as: containers, arrays, random numbers, files, code, objects."""

import copy
import enum
import functools
import io
import os
import random
import sys
import types
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

from sb3_tdc.checkpoint.codec import (
    KINDS,
    LAST,
    MISSING,
    Capture,
    Kind,
    NotCapturedError,
    NotRestoredError,
    Restore,
    attributes_of,
    existing_as,
    is_slot,
    name_of,
    plain,
)

# Code and constants: nothing to capture; they are compared by name when they are restored
_CODE: tuple[type, ...] = (type, types.BuiltinFunctionType, types.ModuleType, property, types.GenericAlias, np.ufunc)
_CODE += (types.MethodDescriptorType, types.WrapperDescriptorType, types.ClassMethodDescriptorType)
_CONSTANTS = (EnvSpec, Path, np.dtype, th.dtype, th.device)
# What draws, or writes rows to a file that is captured itself
_WITHOUT_STATE = ("gymnasium.envs.mujoco.mujoco_rendering.", "pygame.", "_csv.")
# Simulators behind a number or a proxy: the Python objects that use them look as if they could be captured
_NATIVE_PACKAGES = {"pybullet", "pybullet_data", "pybullet_utils", "Box2D", "ale_py", "isaacgym"}
_BIT_GENERATORS = {"PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64"}
# Longer lists of numbers, and arrays of runs of equal numbers, are kept as arrays of a smaller size
_LONG = 64

# ---------------------------------------------------------------- containers


def _capture_list(context: Capture, value: Any, path: str) -> Any:
    return [context.capture(item, f"{path}[{i}]") for i, item in enumerate(value)]


def _items(context: Restore, content: list[Any], existing: Any, path: str) -> list[Any]:
    there = list(existing) if isinstance(existing, (list, tuple, deque)) else []
    there += [MISSING] * (len(content) - len(there))
    return [
        context.restore(node, item, f"{path}[{i}]") for i, (node, item) in enumerate(zip(content, there, strict=False))
    ]


def _restore_named_tuple(context: Restore, content: Any, existing: Any, path: str) -> Any:
    name, items = content
    if name_of(type(existing)) != name:
        raise NotRestoredError(f"{path} was a {name}, and is a {name_of(type(existing))}")
    return type(existing)._make(_items(context, items, existing, path))


def _capture_dict(context: Capture, value: dict[Any, Any], path: str) -> Any:
    return [
        [context.capture(key, f"{path} (a key)"), context.capture(item, f"{path}[{key!r}]")]
        for key, item in value.items()
    ]


def _restore_dict(context: Restore, content: Any, existing: Any, path: str) -> Any:
    there = existing if isinstance(existing, dict) else {}
    restored = copy.copy(there)
    restored.clear()
    for key_node, node in content:
        key = context.restore(key_node, MISSING, path)
        restored[key] = context.restore(node, there.get(key, MISSING), f"{path}[{key!r}]")
    return restored


def _is_long_list_of_numbers(value: Any) -> bool:
    return type(value) is list and len(value) > _LONG and {type(item) for item in value} in ({float}, {int}, {bool})


def _restore_deque(context: Restore, content: Any, existing: Any, path: str) -> Any:
    maxlen, items = content
    return deque(_items(context, items, existing, path), maxlen=maxlen)


# ---------------------------------------------------------------- arrays


def run_lengths(array: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """:return: starts and values of the runs of equal numbers, where that is much smaller; else None"""
    if array.dtype.kind not in "biu" or array.size <= 4096:
        return None
    flat = array.ravel()
    starts = np.flatnonzero(np.concatenate(([True], flat[1:] != flat[:-1])))
    return (starts, flat[starts]) if len(starts) < array.size // 8 else None


def _capture_array(context: Capture, value: np.ndarray, path: str) -> Any:
    if value.dtype.kind == "O":
        return {"shape": list(value.shape), "items": _capture_list(context, list(value.flat), path)}
    if _is_native_memory(value):
        return {"native": list(value.shape)}  # of an object that is captured itself
    if (runs := run_lengths(value)) is not None:
        return {"runs": [context.add_array(part) for part in runs], "shape": list(value.shape)}
    return context.add_array(np.array(value))


def _restore_array(context: Restore, content: Any, existing: Any, path: str) -> Any:
    if isinstance(content, int):
        return context.arrays[content].copy()
    if "native" in content:
        existing = existing_as(np.ndarray, existing, path)
        if not _is_native_memory(existing) or list(existing.shape) != content["native"]:
            raise NotRestoredError(f"{path} was a view of native memory, of shape {content['native']}")
        return existing
    if "runs" in content:
        starts, values = (context.arrays[number] for number in content["runs"])
        counts = np.diff(starts, append=int(np.prod(content["shape"])))
        return np.repeat(values, counts).reshape(content["shape"])
    restored = np.empty(content["shape"], dtype=object)
    restored.ravel()[:] = _items(context, content["items"], MISSING, path)
    return restored


def _is_native_memory(array: np.ndarray) -> bool:
    base = array.base
    while isinstance(base, np.ndarray):
        base = base.base
    return base is not None and not isinstance(base, (bytes, bytearray, memoryview, th.Tensor))


def _restore_tensor(context: Restore, content: Any, existing: Any, path: str) -> Any:
    value = th.from_numpy(context.arrays[content].copy())
    if isinstance(existing, th.Tensor) and existing.shape == value.shape and existing.dtype == value.dtype:
        with th.no_grad():
            return existing.copy_(value)
    return value


def _capture_tensor(context: Capture, value: th.Tensor, path: str) -> Any:
    try:
        return context.add_array(value.detach().cpu().numpy().copy())
    except TypeError as error:
        raise NotCapturedError(f"{path} is a tensor of {value.dtype}") from error


# ---------------------------------------------------------------- random numbers


def _restore_generator(existing: Any, state: dict[str, Any]) -> np.random.Generator:
    name = state["state"]["bit_generator"]
    if name not in _BIT_GENERATORS:
        raise NotRestoredError(f"There is no bit generator {name}")
    if not isinstance(existing, np.random.Generator) or type(existing.bit_generator).__name__ != name:
        existing = np.random.Generator(getattr(np.random, name)())
    existing.bit_generator.state = state["state"]
    return existing


def _restore_random_state(existing: Any, state: dict[str, Any]) -> np.random.RandomState:
    existing = existing if isinstance(existing, np.random.RandomState) else np.random.RandomState()
    existing.set_state(state["state"])
    return existing


def _restore_python_random(existing: Any, state: dict[str, Any]) -> random.Random:
    existing = existing if isinstance(existing, random.Random) else random.Random()
    version, words, gauss = state["state"]
    existing.setstate((version, tuple(words), gauss))
    return existing


def _restore_torch_generator(existing: Any, state: dict[str, Any]) -> th.Generator:
    existing = existing if isinstance(existing, th.Generator) else th.Generator()
    existing.set_state(th.from_numpy(state["state"]))
    return existing


def _python_random_state(value: random.Random) -> dict[str, Any]:
    version, words, gauss = value.getstate()
    return {"state": (version, list(words), gauss)}


# ---------------------------------------------------------------- files


def _capture_text_file(file: Any) -> dict[str, Any]:
    file.flush()
    os.fsync(file.fileno())
    return {"text": Path(file.name).read_bytes()}


def _restore_text_file(existing: Any, state: dict[str, Any]) -> Any:
    existing_as(io.TextIOWrapper, existing, "a text file")
    existing.flush()
    existing.seek(0)
    existing.truncate()
    existing.write(state["text"].decode(existing.encoding))
    existing.flush()
    return existing


def _is_written_file(value: Any) -> bool:
    return isinstance(value, io.TextIOWrapper) and isinstance(value.name, str) and Path(value.name).is_file()


# ---------------------------------------------------------------- code and objects


def _code_name(value: Any) -> str:
    return name_of(value if hasattr(value, "__qualname__") else type(value))


def _is_code(value: Any) -> bool:
    if isinstance(value, types.BuiltinMethodType) and not isinstance(value.__self__, types.ModuleType | type | None):
        return False  # of an instance: it has a state
    if isinstance(value, types.FunctionType):
        return value.__closure__ is None
    module = f"{type(value).__module__}.{type(value).__qualname__}"
    return isinstance(value, _CODE) or module.startswith(_WITHOUT_STATE)


def _restore_code(context: Restore, content: Any, existing: Any, path: str) -> Any:
    if existing is MISSING or _code_name(existing) != content:
        found = "nothing" if existing is MISSING else _code_name(existing)
        raise NotRestoredError(f"{path} was {content}, and is {found}")
    return existing


def _restore_constant(context: Restore, content: Any, existing: Any, path: str) -> Any:
    return existing


def _capture_closure(context: Capture, value: types.FunctionType, path: str) -> Any:
    assert value.__closure__ is not None
    cells = zip(value.__code__.co_freevars, value.__closure__, strict=True)
    return [_code_name(value), {name: context.capture(cell.cell_contents, f"{path}:{name}") for name, cell in cells}]


def _restore_closure(context: Restore, content: Any, existing: Any, path: str) -> Any:
    name, cells = content
    existing = existing_as(types.FunctionType, existing, path)
    if _code_name(existing) != name:
        raise NotRestoredError(f"{path} was {name}, and is {_code_name(existing)}")
    for variable, cell in zip(existing.__code__.co_freevars, existing.__closure__ or (), strict=True):
        value = context.restore(cells[variable], cell.cell_contents, f"{path}:{variable}")
        if value is not cell.cell_contents:
            cell.cell_contents = value
    return existing


def _capture_method(context: Capture, value: types.MethodType, path: str) -> Any:
    return [_code_name(value), context.capture(value.__self__, f"{path}.__self__")]


def _restore_method(context: Restore, content: Any, existing: Any, path: str) -> Any:
    existing = existing_as(types.MethodType, existing, path)
    context.restore(content[1], existing.__self__, f"{path}.__self__")
    return existing


def _capture_partial(context: Capture, value: Any, path: str) -> Any:
    return context.capture([value.func, list(value.args), value.keywords], path)


def _restore_partial(context: Restore, content: Any, existing: Any, path: str) -> Any:
    existing = existing_as(functools.partial, existing, path)
    there = [existing.func, list(existing.args), existing.keywords]
    function, args, keywords = context.restore(content, there, path)
    return functools.partial(function, *args, **keywords)


def _restore_enum(context: Restore, content: Any, existing: Any, path: str) -> Any:
    name, member = content
    if name_of(type(existing)) != name:
        raise NotRestoredError(f"{path} was a {name}, and is a {name_of(type(existing))}")
    return type(existing)[member]


_MADE_AT_RUN_TIME = 1 << 9  # Py_TPFLAGS_HEAPTYPE: by a class statement, or by C that imitates one


def _is_python_object(value: Any) -> bool:
    """Whether all of its state is in its attributes: every class is Python's, and nothing is hidden behind it."""
    classes = type(value).__mro__[:-1]
    pure = all(
        kind.__flags__ & _MADE_AT_RUN_TIME and isinstance(vars(kind).get("__new__"), staticmethod | None)
        for kind in classes
    )
    slots = sum(is_slot(v) for kind in classes for v in vars(kind).values())
    has_attributes = hasattr(value, "__dict__") or any("__slots__" in vars(kind) for kind in classes)
    # The head of an object, its __dict__, its weak references, its slots: native objects are larger
    return pure and has_attributes and type(value).__basicsize__ <= object.__basicsize__ + 8 * (2 + slots)


def _uses_native_package(kind: type) -> str | None:
    for cls in kind.__mro__:
        module = sys.modules.get(cls.__module__)
        packages = {cls.__module__.partition(".")[0]}
        packages |= {
            v.__name__.partition(".")[0] for v in vars(module or object).values() if isinstance(v, types.ModuleType)
        }
        if found := packages & _NATIVE_PACKAGES:
            return found.pop()
    return None


def _capture_object(context: Capture, value: Any, path: str) -> Any:
    kind = type(value)
    if package := _uses_native_package(kind):
        raise NotCapturedError(f"{path} is a {name_of(kind)}, which uses {package}")
    if not getattr(value, "is_checkpointed", True):
        return [name_of(kind), {}]
    is_callback = isinstance(value, BaseCallback)
    return [name_of(kind), context.capture_attributes(attributes_of(value), path, optional=is_callback)]


def _restore_object(context: Restore, content: Any, existing: Any, path: str) -> Any:
    name, nodes = content
    if existing is MISSING or name_of(type(existing)) != name:
        found = "nothing" if existing is MISSING else f"a {name_of(type(existing))}"
        raise NotRestoredError(f"{path} was a {name}, and is {found}")
    context.restore_attributes(nodes, existing, path)
    if getattr(existing, "is_checkpointed", True) and not isinstance(existing, BaseCallback):
        for extra in set(attributes_of(existing)) - set(nodes):
            delattr(existing, extra)
    return existing


def _capture_module(value: nn.Module) -> dict[str, Any]:
    return {"weights": dict(value.state_dict()), "training": value.training}


def _restore_module(existing: Any, state: dict[str, Any]) -> Any:
    existing.load_state_dict(state["weights"])
    return existing.train(state["training"])


KINDS.update(
    {
        "numbers": Kind(
            _is_long_list_of_numbers,
            lambda context, value, path: context.add_array(np.array(value)),
            lambda context, content, existing, path: context.arrays[content].tolist(),
        ),
        "list": Kind(lambda v: type(v) is list, _capture_list, _items),
        "tuple": Kind(
            lambda v: type(v) is tuple, _capture_list, lambda *args: tuple(_items(*args)), has_identity=False
        ),
        "named tuple": Kind(
            lambda v: isinstance(v, tuple) and hasattr(type(v), "_make"),
            lambda context, value, path: [name_of(type(value)), _capture_list(context, value, path)],
            _restore_named_tuple,
            has_identity=False,
        ),
        "dict": Kind(lambda v: isinstance(v, dict), _capture_dict, _restore_dict),
        "set": Kind(
            lambda v: type(v) is set,
            lambda context, value, path: _capture_list(context, sorted(value, key=repr), path),
            lambda *args: set(_items(*args)),
        ),
        "frozenset": Kind(
            lambda v: type(v) is frozenset,
            lambda context, value, path: _capture_list(context, sorted(value, key=repr), path),
            lambda *args: frozenset(_items(*args)),
            has_identity=False,
        ),
        "deque": Kind(
            lambda v: type(v) is deque,
            lambda context, value, path: [value.maxlen, _capture_list(context, value, path)],
            _restore_deque,
        ),
        "array": Kind(lambda v: type(v) is np.ndarray, _capture_array, _restore_array),
        "number": Kind(
            lambda v: isinstance(v, np.generic),
            lambda context, value, path: context.add_array(np.array(value)),
            lambda context, content, existing, path: context.arrays[content][()],
            has_identity=False,
        ),
        "bytes": Kind(
            lambda v: type(v) is bytes,
            lambda context, value, path: context.add_array(np.frombuffer(value, dtype=np.uint8)),
            lambda context, content, existing, path: context.arrays[content].tobytes(),
            has_identity=False,
        ),
        "tensor": Kind(lambda v: isinstance(v, th.Tensor), _capture_tensor, _restore_tensor),
        "generator": plain(
            lambda v: type(v) is np.random.Generator, lambda v: {"state": v.bit_generator.state}, _restore_generator
        ),
        "random state": plain(
            lambda v: isinstance(v, np.random.RandomState),
            lambda v: {"state": v.get_state(legacy=False)},
            _restore_random_state,
        ),
        "python random": plain(lambda v: type(v) is random.Random, _python_random_state, _restore_python_random),
        "torch generator": plain(
            lambda v: isinstance(v, th.Generator), lambda v: {"state": v.get_state().numpy()}, _restore_torch_generator
        ),
        "text file": plain(_is_written_file, _capture_text_file, _restore_text_file),
        "module": plain(lambda v: isinstance(v, nn.Module), _capture_module, _restore_module),
        "enum": Kind(
            lambda v: isinstance(v, enum.Enum),
            lambda context, value, path: [name_of(type(value)), value.name],
            _restore_enum,
            has_identity=False,
        ),
        "code": Kind(_is_code, lambda context, value, path: _code_name(value), _restore_code, has_identity=False),
        "constant": Kind(
            lambda v: isinstance(v, _CONSTANTS), lambda context, value, path: str(value), _restore_constant
        ),
        "closure": Kind(lambda v: isinstance(v, types.FunctionType), _capture_closure, _restore_closure),
        "method": Kind(lambda v: isinstance(v, types.MethodType), _capture_method, _restore_method, has_identity=False),
        "partial": Kind(lambda v: type(v) is functools.partial, _capture_partial, _restore_partial),
    }
)
KINDS[LAST] = Kind(_is_python_object, _capture_object, _restore_object)
