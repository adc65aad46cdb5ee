"""Kinds for code, objects of Python classes, and optimizers: they must already exist, and get back their state."""

import enum
import functools
import hashlib
import re
import sys
import types
from collections import Counter, OrderedDict, defaultdict, deque
from typing import Any

import numpy as np
import torch as th
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_tdc.resume.walk import (
    MISSING,
    Capture,
    NotCapturedError,
    NotRestoredError,
    Restore,
    attributes_of,
    existing_as,
    is_slot,
    name_of,
)

# Code has no state to capture; it is compared by name when it is restored
_CODE: tuple[type, ...] = (type, types.BuiltinFunctionType, types.ModuleType, property, types.GenericAlias, np.ufunc)
_CODE += (types.MethodDescriptorType, types.WrapperDescriptorType, types.ClassMethodDescriptorType, type(np.mean))
# Renderers, and writers of rows to a file that is captured itself
_WITHOUT_STATE = ("gymnasium.envs.mujoco.mujoco_rendering.", "pygame.", "_csv.")
# Simulators that objects reach by a number or a proxy: these Python objects only look as if they could be captured
_NATIVE_PACKAGES = {"pybullet", "pybullet_data", "pybullet_utils", "Box2D", "ale_py", "isaacgym"}
_NATIVE_PACKAGES |= {"isaaclab", "isaaclab_rl", "isaacsim", "omni", "warp"}
# Packages whose classes reach their simulator only through an object that is captured (a BulletClient)
_REACHED_BY_OBJECTS = {"pybullet_envs_gymnasium"}
# Classes that can be restored even if another class, or nothing, is in their place
_BUILTIN: dict[str, type] = {
    name_of(kind): kind
    for kind in (*(bool, int, float, str, bytes, list, tuple, dict, set, frozenset), deque, Counter, OrderedDict)
}
_BUILTIN[name_of(defaultdict)] = defaultdict


def loaded_class(name: str, base: type) -> type | None:
    """
    Find a class in the modules that are already imported; no module is imported.

    :param name: the name of the class, from :func:`name_of`
    :param base: the class that it must be derived from
    :return: the class, or None if it is not found
    """
    parts = name.split(".")
    for i in range(len(parts) - 1, 0, -1):
        found: Any = sys.modules.get(".".join(parts[:i]))
        for part in parts[i:]:
            found = getattr(found, "__dict__", {}).get(part)
        if isinstance(found, type) and issubclass(found, base):
            return found
    return None


# ---------------------------------------------------------------- code


def code_name(value: Any) -> str:
    """Return the name of a class, a function, a module or a similar value."""
    if isinstance(value, (types.ModuleType, np.ufunc)):
        return f"{type(value).__name__} {value.__name__}"
    if isinstance(value, types.GenericAlias):
        return repr(value)
    if isinstance(value, property):
        return f"property {code_name(value.fget)}"
    if isinstance(value, (types.MethodDescriptorType, types.WrapperDescriptorType, types.ClassMethodDescriptorType)):
        return name_of(value.__objclass__) + f".{value.__name__}"
    return name_of(value if hasattr(value, "__qualname__") else type(value))


def is_code(value: Any) -> bool:
    """Return whether a value has no state, and is identified by its name."""
    if isinstance(value, types.BuiltinMethodType) and not isinstance(value.__self__, types.ModuleType | type | None):
        return False  # bound to an instance, which has a state
    if isinstance(value, types.FunctionType):
        module = sys.modules.get(value.__module__)
        return getattr(module, "__dict__", {}).get(value.__qualname__) is value
    kind = f"{type(value).__module__}.{type(value).__qualname__}"
    return isinstance(value, _CODE) or kind.startswith(_WITHOUT_STATE)


def restore_code(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Return the existing value if it has this name, or the built-in class of this name."""
    if existing is not MISSING and code_name(existing) == content:
        return existing
    if content not in _BUILTIN:
        found = "nothing" if existing is MISSING else code_name(existing)
        raise NotRestoredError(f"{path} was {content}, and is {found}")
    return _BUILTIN[content]


def needs_of_code(content: Any) -> str | None:
    """Return the name of a class, function or module that must exist; None for a built-in class."""
    return None if content in _BUILTIN else content


def is_constant(value: Any) -> bool:
    """Return whether a value is only compared, not restored, when a run is resumed."""
    return isinstance(value, EnvSpec)


def describe_constant(value: Any) -> str:
    """Return the id of a constant, and a digest of its ``repr`` without memory addresses."""
    text = re.sub(r" at 0x[0-9a-f]+", "", repr(value))
    return f"the EnvSpec of {value.id} ({hashlib.sha256(text.encode()).hexdigest()[:8]})"


def restore_constant(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Return the existing constant, if it is the same."""
    if not is_constant(existing) or describe_constant(existing) != content:
        raise NotRestoredError(f"{path} was {content}, and is another")
    return existing


# ---------------------------------------------------------------- functions with a state


def capture_function(context: Capture, value: types.FunctionType, path: str) -> Any:
    """Return the name, digest, enclosed values, defaults and attributes of a function."""
    cells = dict(zip(value.__code__.co_freevars, value.__closure__ or (), strict=True))
    return {
        "name": f"{code_name(value)} {_digest(value.__code__)}",
        "cells": {n: context.capture(c.cell_contents, f"{path}:{n}") for n, c in cells.items() if _is_full(c)},
        "defaults": context.capture(value.__defaults__, f"{path} (its defaults)"),
        "keywords": context.capture(value.__kwdefaults__, f"{path} (by keyword)"),
        "attributes": context.capture_attributes(vars(value), path),
    }


def restore_function(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Restore the enclosed values, defaults and attributes of an existing function."""
    there = existing_as(types.FunctionType, existing, path)
    if f"{code_name(there)} {_digest(there.__code__)}" != content["name"]:
        raise NotRestoredError(f"{path} was {content['name']}, and is {code_name(there)} of other code")
    if not context.claims(there):
        raise NotRestoredError(f"{path} was apart from another function, and is the same")
    context.begin(there)
    for variable, cell in zip(there.__code__.co_freevars, there.__closure__ or (), strict=True):
        if variable in content["cells"]:
            before = cell.cell_contents if _is_full(cell) else MISSING
            value = context.restore(content["cells"][variable], before, f"{path}:{variable}")
            if value is not before:
                cell.cell_contents = value
    there.__defaults__ = context.restore(content["defaults"], there.__defaults__, f"{path} (its defaults)")
    there.__kwdefaults__ = context.restore(content["keywords"], there.__kwdefaults__, f"{path} (by keyword)")
    context.restore_attributes(content["attributes"], there, path)
    return there


def children_of_function(content: Any) -> dict[str, Any]:
    """Return the enclosed values, defaults and attributes of a function."""
    cells = {f":{name}": node for name, node in content["cells"].items()}
    attributes = {f".{name}": node for name, node in content["attributes"].items()}
    return {**cells, **attributes, " (its defaults)": content["defaults"], " (by keyword)": content["keywords"]}


def _is_full(cell: Any) -> bool:
    try:
        return cell.cell_contents is not MISSING
    except ValueError:
        return False


def _digest(code: types.CodeType) -> str:
    """Return a digest of a function's code, without its line numbers, which change with any edit of its file."""
    parts = [code.co_code.hex(), *map(repr, (code.co_names, code.co_varnames, code.co_freevars, code.co_argcount))]
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            parts.append(_digest(constant))
        elif isinstance(constant, frozenset):
            parts.append(str(sorted(map(repr, constant))))
        else:
            parts.append(repr(constant))
    return hashlib.sha256("\n".join(parts).encode("utf-8", "surrogatepass")).hexdigest()[:16]


def capture_method(context: Capture, value: types.MethodType, path: str) -> Any:
    """Return the name and the object of a method."""
    return [code_name(value), context.capture(value.__self__, f"{path}.__self__")]


def restore_method(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Return the existing method, bound to its restored object."""
    name, owner = content
    existing = existing_as(types.MethodType, existing, path)
    if code_name(existing) != name:
        raise NotRestoredError(f"{path} was {name}, and is {code_name(existing)}")
    restored = context.restore(owner, existing.__self__, f"{path}.__self__")
    return existing if restored is existing.__self__ else types.MethodType(existing.__func__, restored)


def capture_partial(context: Capture, value: Any, path: str) -> Any:
    """Return the function and the arguments of a ``functools.partial``."""
    if vars(value):
        raise NotCapturedError(f"{path} is a functools.partial with attributes")
    return [context.capture(part, path) for part in (value.func, value.args, value.keywords)]


def restore_partial(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Restore an existing ``functools.partial``, or make a new one."""
    is_there = type(existing) is functools.partial
    there = [existing.func, existing.args, existing.keywords] if is_there else [MISSING] * 3
    func, args, keywords = (context.restore(node, part, path) for node, part in zip(content, there, strict=True))
    if not is_there or not context.claims(existing):
        return functools.partial(func, *args, **keywords)
    existing.__setstate__((func, args, keywords, {}))
    return existing


# ---------------------------------------------------------------- enumerations


def is_member(value: Any) -> bool:
    """Return whether a value is a member of an enumeration that has a name."""
    return isinstance(value, enum.Enum) and value.name in type(value).__members__


def restore_member(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Return the member of an enumeration, by its name."""
    name, member = content
    kind: Any = type(existing) if name_of(type(existing)) == name else loaded_class(name, enum.Enum)
    if kind is None or member not in kind.__members__:
        raise NotRestoredError(f"{path} was {name}.{member}, and is a {name_of(type(existing))}")
    return kind[member]


def needs_of_member(content: Any) -> str | None:
    """Return the class if it is not found in an imported module, and so must already exist; else None."""
    return None if loaded_class(content[0], enum.Enum) else f"a {content[0]}"


# ---------------------------------------------------------------- objects

_MADE_AT_RUN_TIME = 1 << 9  # Py_TPFLAGS_HEAPTYPE: made by a class statement, or by C code that imitates one


def is_made_in_python(kind: type) -> bool:
    """Return whether a class keeps the state of its objects in their attributes only."""
    return bool(kind.__flags__ & _MADE_AT_RUN_TIME) and isinstance(vars(kind).get("__new__"), staticmethod | None)


def is_python_object(value: Any) -> bool:
    """Return whether an object's attributes are all of its state: no base class is written in another language."""
    classes = type(value).__mro__[:-1]
    slots = sum(is_slot(v) for kind in classes for v in vars(kind).values())
    has_attributes = hasattr(value, "__dict__") or any("__slots__" in vars(kind) for kind in classes)
    # The object header, __dict__, the weak references, and the slots; native objects are larger
    is_small = type(value).__basicsize__ <= object.__basicsize__ + 8 * (2 + slots)
    return all(map(is_made_in_python, classes)) and has_attributes and is_small


def uses_native_package(kind: type) -> str | None:
    """Return the simulator that a class reaches by a number or a proxy, if any."""
    for cls in kind.__mro__:
        if cls.__module__.partition(".")[0] in _REACHED_BY_OBJECTS:
            continue
        module = sys.modules.get(cls.__module__)
        packages = {cls.__module__.partition(".")[0]}
        packages |= {
            v.__name__.partition(".")[0] for v in vars(module or object).values() if isinstance(v, types.ModuleType)
        }
        if found := packages & _NATIVE_PACKAGES:
            return found.pop()
    return None


def _is_of_parts(value: Any) -> bool:
    """Return whether each attribute can be restored without the others: statistics without the environments below."""
    return isinstance(value, (BaseCallback, VecEnvWrapper))


def capture_object(context: Capture, value: Any, path: str) -> Any:
    """Return the class and the attributes of an object."""
    kind = type(value)
    if package := uses_native_package(kind):
        raise NotCapturedError(f"{path} is a {name_of(kind)}, which uses {package}")
    if not getattr(value, "is_captured", True):
        return [name_of(kind), {}]
    return [name_of(kind), context.capture_attributes(attributes_of(value), path, optional=_is_of_parts(value))]


def restore_object(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Restore the attributes of an existing object."""
    name, nodes = content
    claim(context, name, existing, path)
    context.begin(existing)
    context.restore_attributes(nodes, existing, path, optional=_is_of_parts(existing))
    if getattr(existing, "is_captured", True) and not _is_of_parts(existing):
        for extra in set(attributes_of(existing)) - set(nodes):
            delattr(existing, extra)
    return existing


def needs_of_object(content: Any) -> str | None:
    """Return the class of an object, which must exist."""
    return f"a {content[0]}"


def attributes_in(content: Any) -> dict[str, Any]:
    """Return the attributes of an object, as its children."""
    return {f".{name}": node for name, node in content[-1].items()}


def capture_optimizer(context: Capture, value: th.optim.Optimizer, path: str) -> Any:
    """Return the class, state and attributes of an optimizer; per-parameter state is keyed by parameter number."""
    others = {name: v for name, v in vars(value).items() if name not in ("state", "param_groups")}
    state = context.capture(value.state_dict(), f"{path}.state")
    return [name_of(type(value)), state, context.capture_attributes(others, path)]


def restore_optimizer(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Restore the state and the attributes of an existing optimizer."""
    name, state, others = content
    claim(context, name, existing, path)
    context.begin(existing)
    existing.load_state_dict(context.restore(state, MISSING, f"{path}.state"))
    context.restore_attributes(others, existing, path)
    return existing


def claim(context: Restore, name: str, existing: Any, path: str) -> None:
    """
    Claim an existing object for a captured object of the same class.

    :param name: the name of the captured object's class
    :raises NotRestoredError: if there is no object of this class, or if it has been claimed before
    """
    if existing is MISSING or name_of(type(existing)) != name:
        found = "nothing" if existing is MISSING else f"a {name_of(type(existing))}"
        raise NotRestoredError(f"{path} was a {name}, and is {found}")
    if not context.claims(existing):
        raise NotRestoredError(f"{path} was a {name} apart from another one, and is the same")
