"""Tensors, weights and states of optimizers, checked before torch or a network sees them."""

import io
import math
import re
import zipfile
from typing import Any

import torch as th
from stable_baselines3.common.policies import BasePolicy

from sb3_tdc.safe_load.archives import read_archive
from sb3_tdc.safe_load.checks import is_plain, reading
from sb3_tdc.safe_load.inert_pickle import PERSISTENT, Call, Name, Rebuild, UnsafeFileError, read_pickle, rebuild
from sb3_tdc.tdc.checks import find_non_finite

_TENSOR_ENTRIES = re.compile(
    r"[\w.-]+/(data\.pkl|version|byteorder|\.format_version|\.storage_alignment|\.data/serialization_id|data/\d+)"
)
_STORAGE_BYTES = {
    "DoubleStorage": 8, "FloatStorage": 4, "HalfStorage": 2, "BFloat16Storage": 2, "LongStorage": 8, "IntStorage": 4,
    "ShortStorage": 2, "CharStorage": 1, "ByteStorage": 1, "BoolStorage": 1,
}  # fmt: skip


def read_tensors(raw: bytes, device: th.device | str) -> Any:
    """
    Check a ``.pth`` file, tensor by tensor, against the bytes that are there; then ``torch.load`` it.

    :return: what ``torch.save`` was given: numbers, texts and tensors, in dicts, lists and tuples
    """
    entries = read_archive(io.BytesIO(raw), _TENSOR_ENTRIES)
    records = {name.partition("/")[2]: content for name, content in entries.items()}
    if "data.pkl" not in records or len(records) != len(entries):
        raise UnsafeFileError("it is not a file of tensors")

    def check_tensor(call: Call, make: Rebuild) -> th.Tensor:
        storage, offset, shape, stride = call.args[:4]
        if not isinstance(storage, Call) or storage.function != PERSISTENT or len(storage.args) != 5:
            raise UnsafeFileError("a tensor without its storage")
        kind, key, size = storage.args[1], storage.args[2], storage.args[4]
        item = _STORAGE_BYTES.get(kind.attribute) if isinstance(kind, Name) and kind.module == "torch" else None
        if item is None or type(size) is not int or size * item != len(records.get(f"data/{key}", b"")):
            raise UnsafeFileError("a tensor with other bytes than it says")
        whole = all(type(number) is int and number >= 0 for number in (offset, *shape, *stride))
        contiguous = tuple(math.prod(shape[i + 1 :]) for i in range(len(shape)))
        if not whole or (math.prod(shape) > 1 and stride != contiguous) or offset + math.prod(shape) > size:
            raise UnsafeFileError("a tensor that is larger than its storage")
        return th.empty(0)

    def check_dict(call: Call, make: Rebuild) -> dict:
        if call.args != () or (call.state is not None and set(call.state) != {"_metadata"}):
            raise UnsafeFileError("a mapping with attributes")
        return {key: make(item) for key, item in call.items}

    known = {Name("torch._utils", "_rebuild_tensor_v2"): check_tensor, Name("collections", "OrderedDict"): check_dict}
    rebuild(read_pickle(records["data.pkl"]), {}, known)
    repacked = io.BytesIO()  # so that torch sees the entries that were checked, and no others
    with zipfile.ZipFile(repacked, "w") as archive:
        for name, content in records.items():
            archive.writestr(f"archive/{name}", content)
    repacked.seek(0)
    return th.load(repacked, map_location=th.device("cpu") if device == "auto" else device, weights_only=True)


class _OnMeta:
    """Before a policy class: its networks get shapes, but no memory."""

    device = th.device("meta")


def check_weights(policy_class: type[BasePolicy], fields: dict[str, Any], weights: Any) -> None:
    """Compare the weights of the file with the networks that its arguments ask for, before these are built."""
    kwargs = {**fields.get("policy_kwargs", {}), "optimizer_class": th.optim.SGD, "optimizer_kwargs": {}}
    if "stochastic_actor" in fields:
        kwargs["stochastic_actor"] = fields["stochastic_actor"]
    shaped: type[Any] = type(policy_class.__name__, (_OnMeta, policy_class), {})
    validates = th.distributions.Distribution._validate_args
    th.distributions.Distribution.set_default_validate_args(False)  # it would look at values, of which there are none
    try:
        with reading("policy_kwargs"), th.device("meta"):
            policy = shaped(fields["observation_space"], fields["action_space"], lambda _: 1.0, **kwargs)
    finally:
        th.distributions.Distribution.set_default_validate_args(validates)
    expected = {name: tuple(tensor.shape) for name, tensor in policy.state_dict().items()}
    if not isinstance(weights, dict) or not all(isinstance(tensor, th.Tensor) for tensor in weights.values()):
        raise UnsafeFileError("policy.pth: it does not hold weights")
    found = {name: tuple(tensor.shape) for name, tensor in weights.items()}
    for name in [*expected, *found]:
        if expected.get(name) != found.get(name):
            raise UnsafeFileError(
                f"policy.pth: {str(name)[:100]} is {found.get(name, 'missing')}, but the environment and policy_kwargs "
                f"make it {expected.get(name, 'nothing')}"
            )
    for name in find_non_finite(policy, weights):
        raise UnsafeFileError(f"policy.pth: {name} has values that are not finite")


_OF_THE_SHAPE_OF_ITS_PARAMETER = {
    "exp_avg", "exp_avg_sq", "max_exp_avg_sq", "exp_inf", "square_avg", "grad_avg", "momentum_buffer",
}  # fmt: skip
_OF_ONE_NUMBER = {"step", "mu_product"}


def check_optimizer(optimizer: th.optim.Optimizer, saved: Any) -> None:
    """:raises UnsafeFileError: unless the saved state is that of this optimizer's parameters"""
    groups = saved["param_groups"]
    if set(saved) != {"state", "param_groups"} or len(groups) != len(optimizer.param_groups):
        raise UnsafeFileError("it is not the state of this optimizer")
    parameters: list[th.Tensor] = []
    for group, fresh in zip(groups, optimizer.param_groups, strict=True):
        first, n = len(parameters), len(fresh["params"])
        if group["params"] != list(range(first, first + n)):
            raise UnsafeFileError("it is of other parameters")
        parameters += fresh["params"]
        for name, value in group.items():
            if name != "params" and (name not in fresh or not is_plain(value)):
                raise UnsafeFileError(f"its {str(name)[:100]!r} is unknown, or is not a finite number")
    for index, state in saved["state"].items():
        for name, value in state.items():
            shape = parameters[index].shape
            fits = (name in _OF_THE_SHAPE_OF_ITS_PARAMETER and value.shape == shape) or (
                name in _OF_ONE_NUMBER and (not isinstance(value, th.Tensor) or value.numel() == 1)
            )
            if value is not None and not fits:
                raise UnsafeFileError(f"its {str(name)[:100]!r} of parameter {index} is unknown, or of another shape")
