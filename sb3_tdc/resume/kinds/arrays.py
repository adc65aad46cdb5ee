"""Kinds for arrays, tensors, and values that JSON cannot represent. An existing array keeps its memory."""

import datetime
import decimal
import fractions
import pathlib
import uuid
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_tdc.resume.kinds.containers import capture_items, items_of, restore_items
from sb3_tdc.resume.locations import UNMOVED
from sb3_tdc.resume.walk import MISSING, Capture, NotCapturedError, NotRestoredError, Restore, existing_as

# ---------------------------------------------------------------- arrays


def run_lengths(array: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the starts and values of runs of equal numbers, or None if they are not much smaller than the array."""
    if array.dtype.kind not in "biu" or array.size <= 4096:
        return None
    flat = array.ravel()
    starts = np.flatnonzero(np.concatenate(([True], flat[1:] != flat[:-1])))
    return (starts, flat[starts]) if len(starts) < array.size // 8 else None


def capture_array(context: Capture, value: np.ndarray, path: str) -> Any:
    """Return the numbers of an array, and which part of which memory it is."""
    if value.dtype.kind == "O":
        return {"shape": list(value.shape), "items": capture_items(context, list(value.flat), path)}
    if value.dtype.hasobject:
        raise NotCapturedError(f"{path} is an array of {value.dtype}")
    content: dict[str, Any] = {}
    if is_native_memory(value):
        content["native"] = list(value.shape)
        if any(_root(value).base is owner for owner in context.owners):
            return content
    content |= {"memory": _memory_of(context, value, path), "part": _part(value)}
    if (runs := run_lengths(value)) is not None:
        return content | {"runs": [context.add_array(part) for part in runs], "shape": list(value.shape)}
    return content | {"array": context.add_array(np.array(value))}


def restore_array(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Restore an array, in place if the existing array is the same part of its memory."""
    if "items" in content:
        return _restore_objects(context, content, existing, path)
    if "native" in content:
        existing = existing_as(np.ndarray, existing, path)
        if not is_native_memory(existing) or list(existing.shape) != content["native"]:
            raise NotRestoredError(f"{path} was a view of native memory, of shape {content['native']}")
        if "memory" not in content:
            return existing
    value = _numbers(context, content)
    if _fits(existing, value, content) and context.claims_memory(content["memory"], _address(existing)):
        existing[...] = value
        return existing
    if "native" not in content:
        return value
    # A new array would no longer be a view of the native memory
    if existing.dtype != value.dtype or existing.tobytes() != value.tobytes():
        raise NotRestoredError(f"{path} is a view of native memory that cannot be written to")
    return existing


def _numbers(context: Restore, content: Any) -> np.ndarray:
    if "runs" not in content:
        return context.array(content["array"]).copy(order="K")
    starts, numbers = (context.array(part) for part in content["runs"])
    counts = np.diff(starts, append=int(np.prod(content["shape"])))
    return np.repeat(numbers, counts).reshape(content["shape"])


def needs_of_array(content: Any) -> str | None:
    """Return a description of an array in native memory, which must exist; None for any other array."""
    return f"a view of native memory, of shape {content['native']}" if "native" in content else None


def children_of_array(content: Any) -> dict[str, Any]:
    """Return the items of an array of objects."""
    return items_of(content.get("items", []))


def _restore_objects(context: Restore, content: Any, existing: Any, path: str) -> Any:
    is_there = type(existing) is np.ndarray and existing.dtype == object and list(existing.shape) == content["shape"]
    value = existing if is_there and context.claims(existing) else np.empty(content["shape"], dtype=object)
    context.begin(value)
    items = restore_items(context, content["items"], list(existing.flat) if is_there else [], path)
    for i, item in enumerate(items):
        value.flat[i] = item
    return value


def _fits(existing: Any, value: np.ndarray, content: Any) -> bool:
    if type(existing) is not np.ndarray or is_native_memory(existing) != ("native" in content):
        return False
    is_alike = existing.dtype == value.dtype and existing.shape == value.shape and _part(existing) == content["part"]
    return is_alike and existing.flags.writeable


def is_native_memory(array: np.ndarray) -> bool:
    """Return whether the memory may belong to a native object that writes to it, as MuJoCo's does."""
    return type(_root(array).base).__name__ == "PyCapsule"


def _root(array: np.ndarray) -> np.ndarray:
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array


def _address(array: np.ndarray) -> int:
    """Return the address of an array's memory: of its owner's whole buffer, if the owner exposes it."""
    whole = _root(array)
    with suppress(TypeError, ValueError, BufferError):
        whole = np.frombuffer(whole.base, dtype=np.uint8)  # type: ignore[arg-type]
    return whole.__array_interface__["data"][0]


def _part(array: np.ndarray) -> list[Any] | None:
    """Return the offset (bytes) and strides of an array in its memory; None if it owns the memory."""
    if array.base is None:
        return None
    return [array.__array_interface__["data"][0] - _address(array), list(array.strides)]


def _memory_of(context: Capture, array: Any, path: str) -> int:
    """Note the memory of an array or a tensor, and return its number in this capture."""
    is_tensor = isinstance(array, th.Tensor)
    size = array.numel() if is_tensor else array.size
    address = array.untyped_storage().data_ptr() if is_tensor else _address(array)
    part = [str(array.dtype), list(array.shape), None if is_tensor else _part(array)]
    return context.note_memory(address if size else None, path, part)


# ---------------------------------------------------------------- tensors


def is_tensor(value: Any) -> bool:
    """Return whether a value is a tensor or a parameter, but not of a derived class."""
    return type(value) in (th.Tensor, nn.Parameter)


def capture_tensor(context: Capture, value: th.Tensor, path: str) -> Any:
    """Return the numbers, the gradient and the device of a tensor."""
    if value.grad_fn is not None or vars(value):
        raise NotCapturedError(f"{path} is a tensor with {'attributes' if vars(value) else 'a history of gradients'}")
    try:
        array = value.detach().cpu().numpy().copy()
    except (TypeError, RuntimeError) as error:
        raise NotCapturedError(f"{path} is a tensor of {value.dtype}, {value.layout}") from error
    return {
        "array": context.add_array(array),
        "memory": _memory_of(context, value, path),
        "parameter": type(value) is nn.Parameter,
        "requires_grad": value.requires_grad,
        "device": str(value.device),
        "gradient": context.capture(value.grad, f"{path}.grad"),
    }


def restore_tensor(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Restore a tensor, in place if the existing tensor has its shape and dtype."""
    value = th.from_numpy(context.array(content["array"]).copy())
    kind = nn.Parameter if content["parameter"] else th.Tensor
    fits = type(existing) is kind and existing.shape == value.shape and existing.dtype == value.dtype
    fits = fits and existing.is_leaf and existing.is_contiguous()
    if fits and context.claims_memory(content["memory"], existing.untyped_storage().data_ptr()):
        existing.detach().copy_(value)
    else:
        device = existing.device if isinstance(existing, th.Tensor) else th.device(content["device"])
        value = value.to(device if device.type == "cpu" or th.cuda.is_available() else "cpu")
        existing = nn.Parameter(value, requires_grad=False) if content["parameter"] else value
    existing.requires_grad_(content["requires_grad"])
    existing.grad = context.restore(content["gradient"], existing.grad, f"{path}.grad")
    return existing


# ---------------------------------------------------------------- bytes, numbers, and values made from others


def capture_number(context: Capture, value: Any, path: str) -> Any:
    """Return a NumPy scalar as an array."""
    array = np.array(value)
    if array.dtype.hasobject or type(array[()]) is not type(value) or array.tobytes() != np.asarray(value).tobytes():
        raise NotCapturedError(f"{path} is a {type(value).__name__} of {array.dtype}")
    if array.dtype.kind in "US" and array[()] != value:  # NumPy drops trailing null characters
        raise NotCapturedError(f"{path} is a text that numpy does not keep whole")
    return context.add_array(array)


def capture_bytes(context: Capture, value: Any, path: str) -> Any:
    """Return bytes as an array."""
    return context.add_array(np.frombuffer(bytes(value), dtype=np.uint8))


def restore_bytes(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Return new bytes."""
    return context.array(content).tobytes()


def restore_bytearray(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Restore a bytearray, in place if there is one."""
    value = existing if type(existing) is bytearray and context.claims(existing) else bytearray()
    value[:] = context.array(content).tobytes()
    return value


def _torch_type(name: str) -> th.dtype:
    found = vars(th).get(name)
    if not isinstance(found, th.dtype):
        raise NotRestoredError(f"There is no torch.{name}")
    return found


# Immutable values by name: their class, how to get the parts they are made from, and how to make them
_MADE: dict[str, tuple[type, Callable[[Any], list[Any]], Callable[..., Any]]] = {
    "complex": (complex, lambda v: [v.real, v.imag], complex),
    "range": (range, lambda v: [v.start, v.stop, v.step], range),
    "slice": (slice, lambda v: [v.start, v.stop, v.step], slice),
    "PosixPath": (pathlib.PosixPath, lambda v: [str(v)], pathlib.Path),
    "WindowsPath": (pathlib.WindowsPath, lambda v: [str(v)], pathlib.Path),
    "PurePosixPath": (pathlib.PurePosixPath, lambda v: [str(v)], pathlib.PurePosixPath),
    "PureWindowsPath": (pathlib.PureWindowsPath, lambda v: [str(v)], pathlib.PureWindowsPath),
    "timedelta": (datetime.timedelta, lambda v: [v.days, v.seconds, v.microseconds], datetime.timedelta),
    "datetime": (datetime.datetime, lambda v: [v.isoformat()], datetime.datetime.fromisoformat),
    "date": (datetime.date, lambda v: [v.isoformat()], datetime.date.fromisoformat),
    "decimal": (decimal.Decimal, lambda v: [str(v)], decimal.Decimal),
    "fraction": (fractions.Fraction, lambda v: [v.numerator, v.denominator], fractions.Fraction),
    "uuid": (uuid.UUID, lambda v: [str(v)], uuid.UUID),
    "numpy's type": (np.dtype, lambda v: [v.str], np.dtype),
    "torch's type": (th.dtype, lambda v: [str(v).removeprefix("torch.")], _torch_type),
    "device": (th.device, lambda v: [str(v)], th.device),
}


def is_made(value: Any) -> bool:
    """Return whether a value can be made from a few simpler values."""
    return _row(value) is not None


def _row(value: Any) -> str | None:
    kinds = (name for name, (kind, *_) in _MADE.items() if type(value) is kind)
    return next(kinds, "numpy's type" if isinstance(value, np.dtype) else None)


def capture_made(context: Capture, value: Any, path: str) -> Any:
    """Return the name of a value's kind, and the parts that the value is made from."""
    name = _row(value)
    assert name is not None
    _, parts, make = _MADE[name]
    again = make(*parts(value))
    if type(again) is not type(value) or repr(again) != repr(value):
        raise NotCapturedError(f"{path} is {value!r}")
    return [name, capture_items(context, parts(value), path)]


def restore_made(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Make a value from its parts."""
    name, parts = content
    kind, _, make = _MADE[name]
    if not issubclass(kind, pathlib.Path):
        return make(*restore_items(context, parts, [], path))
    with context.texts(UNMOVED):  # found below, once
        (text,) = restore_items(context, parts, [], path)
    there = str(existing) if isinstance(existing, pathlib.PurePath) else MISSING
    return make(context.locations.find(text, there, f"{path}[0]", is_path=True))


def restore_integer(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Return an integer that is too large for JSON."""
    return int(content, 16)


def restore_text(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Return a text that JSON cannot hold."""
    return bytes.fromhex(content).decode("utf-8", "surrogatepass")
