"""Tensors, weights and optimizer states, checked before PyTorch or a network uses them."""

import inspect
import io
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from threading import get_ident
from typing import Any

import torch as th
from stable_baselines3.common.policies import BasePolicy
from torch.nn.modules.module import register_module_parameter_registration_hook

from sb3_tdc.common.finite import find_non_finite
from sb3_tdc.common.untrusted import escaped, shown
from sb3_tdc.safe_load.archives import read_archive
from sb3_tdc.safe_load.budget import Budget, UnsafeFileError
from sb3_tdc.safe_load.inert_pickle import PERSISTENT, Call, Handler, Name, Rebuild, read_pickle
from sb3_tdc.safe_load.reading import reading

_TENSOR_ENTRIES = re.compile(
    r"[\w.-]+/(data\.pkl|version|byteorder|\.format_version|\.storage_alignment|\.data/serialization_id|data/\d+)"
)
_STORAGE_TYPES = {
    "DoubleStorage": th.float64, "FloatStorage": th.float32, "HalfStorage": th.float16, "BFloat16Storage": th.bfloat16,
    "LongStorage": th.int64, "IntStorage": th.int32, "ShortStorage": th.int16, "CharStorage": th.int8,
    "ByteStorage": th.uint8, "BoolStorage": th.bool,
}  # fmt: skip
MAX_DIMENSIONS = 8
MAX_PARAMETERS = 8192  # tensors; 256 critics with three hidden layers have 4,096, target critics included


def read_tensors(raw: bytes, budget: Budget) -> Any:
    """
    Read a ``.pth`` file: its pickle describes the tensors, and its records hold their bytes.

    :param budget: of the file that contains it
    :return: the object given to ``torch.save``: numbers, texts and tensors (on the CPU), in dicts, lists and tuples
    """
    entries = read_archive(io.BytesIO(raw), _TENSOR_ENTRIES, budget)
    records = {name.partition("/")[2]: content for name, content in entries.items()}
    if "data.pkl" not in records or len(records) != len(entries):
        raise UnsafeFileError("it is not a file of tensors")
    if records.get("byteorder", b"little") != b"little":
        raise UnsafeFileError("its numbers are in the order of another kind of processor")
    tensors = _Tensors(records, budget)
    known = {
        Name("torch._utils", "_rebuild_tensor_v2"): Handler(tensors.make, args=(6, 7)),
        # The state is the attribute of a state dict, _metadata: the versions of its modules
        Name("collections", "OrderedDict"): Handler(_make_dict, state=True, pairs=True),
    }
    return Rebuild({}, known, budget)(read_pickle(records["data.pkl"], budget))


def _make_dict(call: Call, make: Rebuild) -> dict:
    if call.state is not None and not (isinstance(call.state, dict) and set(call.state) == {"_metadata"}):
        raise UnsafeFileError("a mapping with attributes")
    return make.mapping(call.pairs)


class _Tensors:
    """The storages of one file. A storage has one type, and all tensors that refer to it share its memory."""

    def __init__(self, records: dict[str, bytes], budget: Budget):
        self.records, self.budget = records, budget
        self.storages: dict[str, th.Tensor] = {}

    def make(self, call: Call, make: Rebuild) -> th.Tensor:
        """Return the part of a storage that a call of ``_rebuild_tensor_v2`` describes."""
        storage, offset, shape, stride, requires_grad, hooks, *metadata = call.args
        flat = self._storage(storage)
        numbers = (offset, *shape, *stride) if isinstance(shape, tuple) and isinstance(stride, tuple) else (-1,)
        whole = all(type(number) is int and 0 <= number <= flat.numel() for number in numbers)
        if not whole or len(shape) > MAX_DIMENSIONS or len(shape) != len(stride):
            raise UnsafeFileError("a tensor of a shape that it cannot have")
        size = math.prod(shape)
        contiguous = tuple(math.prod(shape[i + 1 :]) for i in range(len(shape)))
        if (size > 1 and stride != contiguous) or offset + size > flat.numel():
            raise UnsafeFileError("a tensor that is larger than its storage, or not stored in a row")
        has_hooks = make(hooks) != {} or any(part not in (None, {}) for part in metadata)
        if not isinstance(requires_grad, bool) or has_hooks:
            raise UnsafeFileError("a tensor with hooks or attributes")
        return flat[offset : offset + size].view(shape)

    def _storage(self, storage: Any) -> th.Tensor:
        """Return a storage as a tensor (size,), of the type of the storage."""
        is_call = isinstance(storage, Call) and storage.function == PERSISTENT and storage.state is None
        if not is_call or not isinstance(storage.args, tuple) or len(storage.args) != 5:
            raise UnsafeFileError("a tensor without its storage")
        tag, kind, key, location, size = storage.args
        dtype = _STORAGE_TYPES.get(kind.attribute) if isinstance(kind, Name) and kind.module == "torch" else None
        if tag != "storage" or dtype is None or not isinstance(key, str) or not isinstance(location, str):
            raise UnsafeFileError("a storage of an unknown kind")
        content = self.records.get(f"data/{key}", b"")
        if type(size) is not int or size * dtype.itemsize != len(content):
            raise UnsafeFileError("a tensor with other bytes than it says")
        if key not in self.storages:
            self.budget.take_bytes(len(content))
            if dtype == th.bool and content.strip(b"\0\1"):
                raise UnsafeFileError("booleans that are neither true nor false")
            # A bytearray is a writable copy: the bytes of the file are read-only
            self.storages[key] = th.frombuffer(bytearray(content), dtype=dtype) if content else th.empty(0, dtype=dtype)
        if self.storages[key].dtype != dtype:
            raise UnsafeFileError("a storage that is said to be of two types")
        return self.storages[key]


class _OnMeta:
    """Mixin that puts a policy on PyTorch's ``meta`` device: its networks get shapes, but no memory."""

    device = th.device("meta")


@contextmanager
def _few_parameters(budget: Budget) -> Iterator[None]:
    """Bound the number of parameter tensors, and the time to build them: each takes 0.1 ms, even without memory."""
    thread, left = get_ident(), iter(range(MAX_PARAMETERS))

    def count(*_: Any) -> None:
        if get_ident() != thread:  # a network that another thread builds meanwhile
            return
        budget.check_time()
        if next(left, None) is None:
            raise UnsafeFileError(f"networks of more than {MAX_PARAMETERS:,} tensors of parameters")

    hook = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        hook.remove()


def check_weights(policy_class: type[BasePolicy], fields: dict[str, Any], weights: Any, budget: Budget) -> None:
    """
    Compare the weights of the file with the networks that its arguments describe, before the networks are built.

    :param budget: of the file. Tensors may share a storage, so the networks can be larger than the bytes of the file
    :raises UnsafeFileError: if the weights do not fit the networks, or are not finite
    """
    kwargs = {**fields.get("policy_kwargs", {}), "optimizer_class": th.optim.SGD, "optimizer_kwargs": {}}
    if "stochastic_actor" in fields:
        kwargs["stochastic_actor"] = fields["stochastic_actor"]
    shaped: type[Any] = type(policy_class.__name__, (_OnMeta, policy_class), {})
    validates = th.distributions.Distribution._validate_args
    th.distributions.Distribution.set_default_validate_args(False)  # it would read values, and meta tensors have none
    try:
        with reading("policy_kwargs"), th.device("meta"), _few_parameters(budget):
            policy = shaped(fields["observation_space"], fields["action_space"], lambda _: 1.0, **kwargs)
    finally:
        th.distributions.Distribution.set_default_validate_args(validates)
    networks = policy.state_dict()
    expected = {name: tuple(tensor.shape) for name, tensor in networks.items()}
    if not isinstance(weights, dict) or not all(isinstance(tensor, th.Tensor) for tensor in weights.values()):
        raise UnsafeFileError("policy.pth: it does not hold weights")
    found = {name: tuple(tensor.shape) for name, tensor in weights.items()}
    for name in [*expected, *found]:
        if expected.get(name) != found.get(name):
            raise UnsafeFileError(
                f"policy.pth: {escaped(str(name))} is {found.get(name, 'missing')}, but the environment and "
                f"policy_kwargs make it {expected.get(name, 'nothing')}"
            )
        if weights[name].dtype != (dtype := networks[name].dtype):
            raise UnsafeFileError(f"policy.pth: {escaped(str(name))} is of {weights[name].dtype}, not of {dtype}")
    budget.take_bytes(sum(tensor.numel() * tensor.itemsize for tensor in networks.values()))
    for name in find_non_finite(policy, weights):
        raise UnsafeFileError(f"policy.pth: {escaped(str(name))} has values that are not finite")


def check_optimizer(optimizer: th.optim.Optimizer, saved: Any) -> None:
    """
    Check the saved state of an optimizer.

    :raises UnsafeFileError: unless this optimizer can have the saved state, before or after some steps
    """
    if not isinstance(saved, dict) or set(saved) != {"state", "param_groups"}:
        raise UnsafeFileError("it is not the state of an optimizer")
    groups, states = saved["param_groups"], saved["state"]
    if not isinstance(groups, list) or len(groups) != len(optimizer.param_groups) or not isinstance(states, dict):
        raise UnsafeFileError("it is not the state of this optimizer")
    parameters: list[th.Tensor] = []
    for group, fresh in zip(groups, optimizer.param_groups, strict=True):
        first, n = len(parameters), len(fresh["params"])
        if not isinstance(group, dict) or group.get("params") != list(range(first, first + n)):
            raise UnsafeFileError("it is of other parameters")
        parameters += fresh["params"]
        for name in {*group, *fresh} - {"params"}:
            # Older versions of PyTorch wrote fewer options; load_state_dict fills in the others
            if name in group and (name not in fresh or not _is_like(group[name], fresh[name])):
                raise UnsafeFileError(f"its {shown(name)} is unknown, or is not what it can be")
    expected = _state_after_a_step(optimizer)
    for index, state in states.items():
        if type(index) is not int or not 0 <= index < len(parameters) or not isinstance(state, dict):
            raise UnsafeFileError("it has a state of a parameter that there is not")
        if set(state) != set(expected):
            raise UnsafeFileError(f"its state of parameter {index} lacks a part, or has an unknown one")
        for name, value in state.items():
            if not _is_state(value, expected[name], parameters[index].shape):
                raise UnsafeFileError(f"its {shown(name)} of parameter {index} is not what it can be")


def _state_after_a_step(optimizer: th.optim.Optimizer) -> dict[str, Any]:
    """Return the state that this optimizer keeps for a parameter of shape (2,), after one step."""
    parameter = th.zeros(2, requires_grad=True)
    kind: Any = type(optimizer)
    taken = inspect.signature(kind).parameters
    options = {name: optimizer.param_groups[0][name] for name in optimizer.defaults if name in taken}
    tried = kind([parameter], **options)
    parameter.grad = th.zeros(2)
    tried.step()
    return dict(tried.state[parameter])


def _is_state(value: Any, expected: Any, shape: th.Size) -> bool:
    if expected is None or value is None:
        return value is expected
    is_number = not isinstance(expected, th.Tensor) or expected.numel() == 1
    if is_number and isinstance(value, (int, float)) and not isinstance(value, bool):
        return math.isfinite(value) and value >= 0
    if not isinstance(value, th.Tensor) or not value.dtype.is_floating_point:
        return False
    # load_state_dict would convert moments of another type, and so copy even those that share a storage
    fits = value.numel() == 1 if is_number else value.shape == shape and value.dtype == expected.dtype
    return fits and bool(value.isfinite().all()) and not (is_number and value.item() < 0)


def _is_like(value: Any, fresh: Any) -> bool:
    """Return whether a saved option is of the same kind as the optimizer's: a number, a truth value or a tuple."""
    if isinstance(value, bool) or isinstance(fresh, bool):
        return isinstance(value, bool | None) and isinstance(fresh, bool | None)
    if isinstance(fresh, (int, float)):
        return isinstance(value, (int, float)) and math.isfinite(value) and abs(value) < 2**31
    if isinstance(fresh, tuple):
        same_length = isinstance(value, (tuple, list)) and len(value) == len(fresh)
        return same_length and all(map(_is_like, value, fresh))
    return value is None or (fresh is None and isinstance(value, (int, float)) and math.isfinite(value))
