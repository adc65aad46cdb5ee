"""The objects that a saved model may hold: their names in a file, and how each is made from plain data."""

import math
import re
from collections import OrderedDict
from collections.abc import Callable
from enum import Enum
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.her import GoalSelectionStrategy, HerReplayBuffer

from sb3_tdc.common.noise import NormalNoiseRange
from sb3_tdc.common.saved_fields import integer, number
from sb3_tdc.common.untrusted import shown
from sb3_tdc.safe_load.budget import Budget, UnsafeFileError
from sb3_tdc.safe_load.inert_pickle import Call, Handler, Name, Rebuild
from sb3_tdc.safe_load.reading import MAX_ITEMS

MAX_DIMENSIONS = 8
MAX_CHOICES = 65_536  # size of the nvec of a MultiDiscrete space, which SB3 sums one by one


def pickled_name(cls: type) -> Name:
    """Return the name by which a pickle refers to a class."""
    return Name(cls.__module__, cls.__qualname__)


# Each class is called without arguments, or with those that the policy or the algorithm passes to it
CLASSES: dict[Name, type] = {
    pickled_name(cls): cls
    for cls in (
        *(getattr(th.nn.modules.activation, name) for name in th.nn.modules.activation.__all__),
        *(th.optim.Adam, th.optim.AdamW, th.optim.Adamax, th.optim.NAdam, th.optim.RAdam, th.optim.RMSprop),
        *(th.optim.SGD, RMSpropTFLike),
        *(FlattenExtractor, NatureCNN, CombinedExtractor),
        *(ReplayBuffer, DictReplayBuffer, NStepReplayBuffer, HerReplayBuffer),
        *(np.float32, np.float64),
    )
}


def _state(call: Call) -> dict[str, Any]:
    if not isinstance(call.state, dict):
        raise UnsafeFileError(f"a {call.function} without its attributes")
    return call.state


def _attributes(call: Call, make: Rebuild, *names: str) -> list[Any]:
    """Return the named attributes of an object, in order; its other attributes are not read."""
    state = _state(call)
    missing = [name for name in names if name not in state]
    if missing:
        raise UnsafeFileError(f"a {call.function} without {missing[0]}")
    return [make(state[name]) for name in names]


def _arguments(call: Call, make: Rebuild, n: int) -> list[Any]:
    return [make(argument) for argument in call.args[:n]]


# -------------------------------------------------------------------- numpy


def _dtype(call: Call, make: Rebuild) -> np.dtype:
    (name,) = _arguments(call, make, 1)
    order = call.state[1] if isinstance(call.state, tuple) and len(call.state) > 1 else "="
    if not isinstance(name, str) or not re.fullmatch(r"b1|[iu][1248]|f[248]", name) or order not in ("<", "|", "="):
        raise UnsafeFileError("an array of something else than numbers")
    return np.dtype(name)


def _array(raw: Any, dtype: Any, shape: Any, order: str, budget: Budget) -> np.ndarray:
    """Return a writable array (shape); ``raw`` must have exactly as many bytes as the array."""
    sizes = shape if isinstance(shape, tuple) else ()
    whole = isinstance(shape, tuple) and all(type(size) is int and size >= 0 for size in sizes)
    if not isinstance(raw, (bytes, bytearray)) or not isinstance(dtype, np.dtype) or not whole:
        raise UnsafeFileError("a damaged array")
    fits = len(sizes) <= MAX_DIMENSIONS and all(size < 2**40 for size in sizes)
    if not fits or math.prod(sizes) * dtype.itemsize != len(raw):
        raise UnsafeFileError(f"an array of {len(raw):,} bytes that says it is another size")
    budget.take_bytes(len(raw))
    array = np.frombuffer(raw, dtype).reshape(sizes, order="F" if order == "F" else "C")
    # The array of a bytearray is writable already, so the gigabytes of a replay buffer are not copied
    return array if isinstance(raw, bytearray) else array.copy()


def _array_of_state(call: Call, make: Rebuild) -> np.ndarray:
    if not isinstance(call.state, tuple) or len(call.state) != 5:
        raise UnsafeFileError("a damaged array")
    _, shape, dtype, fortran_order, raw = (make(part) for part in call.state)
    return _array(raw, dtype, shape, "F" if fortran_order else "C", make.budget)


def _array_of_buffer(call: Call, make: Rebuild) -> np.ndarray:
    raw, dtype, shape, order = _arguments(call, make, 4)
    return _array(raw, dtype, shape, order, make.budget)


def _numpy_scalar(call: Call, make: Rebuild) -> Any:
    """Return a NumPy scalar."""
    dtype, raw = _arguments(call, make, 2)
    return _array(raw, dtype, (), "C", make.budget)[()]


def _scalar(call: Call, make: Rebuild) -> Any:
    return _numpy_scalar(call, make).item()


def _floats(value: Any, budget: Budget) -> np.ndarray:
    """Convert a number, a list of numbers or an array to float64, after taking its bytes from the budget."""
    if isinstance(value, np.ndarray):
        budget.take_bytes(8 * value.size)
    elif not all(isinstance(each, (int, float)) for each in (value if isinstance(value, (list, tuple)) else [value])):
        raise UnsafeFileError("an array of something else than numbers")  # NumPy would also parse texts
    return np.asarray(value, dtype=np.float64)


# -------------------------------------------------------------------- spaces


def _box(call: Call, make: Rebuild) -> spaces.Box:
    low, high = _attributes(call, make, "low", "high")
    if not (isinstance(low, np.ndarray) and isinstance(high, np.ndarray) and low.shape == high.shape):
        raise UnsafeFileError("a Box without bounds of one shape")
    make.budget.take_bytes(4 * low.nbytes)  # Box keeps copies of both bounds, and masks of where they are finite
    return spaces.Box(low, high, dtype=low.dtype.type)


def _dict_space(call: Call, make: Rebuild) -> spaces.Dict:
    (of_keys,) = _attributes(call, make, "spaces")
    is_of_names = isinstance(of_keys, dict) and all(isinstance(key, str) for key in of_keys)
    if not is_of_names or not all(isinstance(part, spaces.Space) for part in of_keys.values()):
        raise UnsafeFileError("a Dict space without its spaces")
    if len(of_keys) > MAX_ITEMS:  # a network is built for each part
        raise UnsafeFileError(f"a Dict space of {len(of_keys):,} parts, more than {MAX_ITEMS}")
    return spaces.Dict(OrderedDict(of_keys))


def _discrete(call: Call, make: Rebuild) -> spaces.Discrete:
    (n,) = _attributes(call, make, "n")
    start = make(_state(call).get("start", 0))
    return spaces.Discrete(integer(1)("n of a Discrete space", n), start=start)


def _multi_discrete(call: Call, make: Rebuild) -> spaces.MultiDiscrete:
    (nvec,) = _attributes(call, make, "nvec")
    if not isinstance(nvec, np.ndarray) or nvec.size > MAX_CHOICES:
        raise UnsafeFileError(f"a MultiDiscrete space whose nvec is no array of at most {MAX_CHOICES:,} numbers")
    make.budget.take_bytes(2 * 8 * nvec.size)  # MultiDiscrete keeps a copy and the first values, both as int64
    return spaces.MultiDiscrete(nvec)


def _multi_binary(call: Call, make: Rebuild) -> spaces.MultiBinary:
    (n,) = _attributes(call, make, "n")
    size = integer(1)("n of a MultiBinary space", n)
    make.budget.take_bytes(size)
    return spaces.MultiBinary(size)


# -------------------------------------------------------------------- the settings of a run


def _normal_noise(call: Call, make: Rebuild) -> NormalActionNoise:
    return NormalActionNoise(*_noise_arrays(call, make))


def _ornstein_uhlenbeck_noise(call: Call, make: Rebuild) -> OrnsteinUhlenbeckActionNoise:
    theta, dt, initial = _attributes(call, make, "_theta", "_dt", "initial_noise")
    if initial is not None and not isinstance(initial, np.ndarray):
        raise UnsafeFileError("initial noise that is not an array")
    mean, sigma = _noise_arrays(call, make)
    make.budget.take_bytes(mean.nbytes)  # it also keeps its last values
    return OrnsteinUhlenbeckActionNoise(mean, sigma, number()("theta", theta), number()("dt", dt), initial)


def _noise_range(call: Call, make: Rebuild) -> NormalNoiseRange:
    mean, smallest = _noise_arrays(call, make, "smallest")
    _, largest = _noise_arrays(call, make, "largest")
    if not mean.shape == smallest.shape == largest.shape:
        raise UnsafeFileError("a range of noise without two ends of one shape")
    return NormalNoiseRange(mean, smallest, largest)


def _noise_arrays(call: Call, make: Rebuild, sigma_name: str = "_sigma") -> tuple[np.ndarray, np.ndarray]:
    mean, sigma = (_floats(value, make.budget) for value in _attributes(call, make, "_mu", sigma_name))
    if not (np.isfinite(mean).all() and np.isfinite(sigma).all()):
        raise UnsafeFileError("noise that is not finite")
    return mean, sigma


def _base_noise(call: Call, make: Rebuild) -> Any:
    # learn() vectorises the noise again, for the number of environments that the model then has
    return _attributes(call, make, "_base_noise")[0]


def _linear_schedule(call: Call, make: Rebuild) -> LinearSchedule:
    names = ("start", "end", "end_fraction")
    values = _attributes(call, make, *names)
    return LinearSchedule(*(number()(name, value) for name, value in zip(names, values, strict=True)))


def _zoo_schedule(call: Call, make: Rebuild) -> LinearSchedule:
    (initial,) = _attributes(call, make, "initial_value")
    return LinearSchedule(number()("initial_value", initial), 0.0, 1.0)


def _constant_schedule(call: Call, make: Rebuild) -> ConstantSchedule:
    return ConstantSchedule(number()("val", *_attributes(call, make, "val")))


def _float_schedule(call: Call, make: Rebuild) -> FloatSchedule:
    (schedule,) = _attributes(call, make, "value_schedule")
    if not isinstance(schedule, (LinearSchedule, ConstantSchedule)):
        raise UnsafeFileError("a schedule of something else than a schedule")
    return FloatSchedule(schedule)


def _train_freq(call: Call, make: Rebuild) -> TrainFreq:
    frequency, unit = _arguments(call, make, 2)
    if not isinstance(unit, TrainFrequencyUnit):
        raise UnsafeFileError("a train_freq without its unit")
    return TrainFreq(integer(1)("frequency", frequency), unit)


def _ordered_dict(call: Call, make: Rebuild) -> OrderedDict[Any, Any]:
    return OrderedDict(make.mapping(call.pairs))


def _running_mean_std(call: Call, make: Rebuild) -> RunningMeanStd:
    mean, var, count = _attributes(call, make, "mean", "var", "count")
    statistics = RunningMeanStd()
    statistics.mean, statistics.var = _floats(mean, make.budget), _floats(var, make.budget)
    statistics.count = number(0.0)("count", count)
    finite = np.isfinite(statistics.mean).all() and np.isfinite(statistics.var).all()
    if not finite or (statistics.var < 0).any() or statistics.mean.shape != statistics.var.shape:
        raise UnsafeFileError("statistics that are not finite means and variances of one shape")
    return statistics


_SB3 = "stable_baselines3.common"
_ENUMS: dict[Name, type[Enum]] = {
    Name(f"{_SB3}.type_aliases", "TrainFrequencyUnit"): TrainFrequencyUnit,
    pickled_name(GoalSelectionStrategy): GoalSelectionStrategy,
}


def _enum_of_value(call: Call, make: Rebuild) -> Enum:
    (value,) = _arguments(call, make, 1)
    for member in _ENUMS[call.function]:
        if type(value) is type(member.value) and value == member.value:
            return member
    raise UnsafeFileError(f"{shown(value)} instead of a {_ENUMS[call.function].__name__}")


def _enum_of_name(call: Call, make: Rebuild) -> Enum:
    """Return the member of ``getattr(SomeEnum, "MEMBER")``, which is how early versions of Python 3.11 pickle it."""
    cls, member = call.args
    return _ENUMS[cls][member]


def _is_member(cls: Any, member: Any) -> bool:
    return isinstance(cls, Name) and cls in _ENUMS and isinstance(member, str) and member in _ENUMS[cls].__members__


def _object(make: Callable[[Call, Rebuild], Any]) -> Handler:
    """Return the handler for an object that is created without arguments and then given its attributes."""
    return Handler(make, state=True)


def _of_numpy(make_scalar: Callable[[Call, Rebuild], Any]) -> dict[Name, Handler]:
    return {
        Name("numpy", "dtype"): Handler(_dtype, args=(1, 3), state=True),
        # NumPy 2 renamed numpy.core to numpy._core
        **{
            Name(f"numpy.{core}.{module}", function): handler
            for core in ("core", "_core")
            for module, function, handler in (
                ("multiarray", "_reconstruct", Handler(_array_of_state, args=(3, 3), state=True)),
                ("multiarray", "scalar", Handler(make_scalar, args=(2, 2))),
                ("numeric", "_frombuffer", Handler(_array_of_buffer, args=(4, 4))),
            )
        },
    }


_MAPPING = {Name("collections", "OrderedDict"): Handler(_ordered_dict, pairs=True)}
# Calls that make plain values; NumPy scalars stay NumPy scalars
PLAIN_CALLS: dict[Name, Handler] = {**_MAPPING, **_of_numpy(_numpy_scalar)}
CALLS: dict[Name, Handler] = {
    **_MAPPING,
    **_of_numpy(_scalar),
    # Older files name gym, the predecessor of gymnasium
    **{
        Name(f"{gym}.spaces.{module}", space): _object(make)
        for gym in ("gym", "gymnasium")
        for module, space, make in (
            ("box", "Box", _box),
            ("dict", "Dict", _dict_space),
            ("discrete", "Discrete", _discrete),
            ("multi_discrete", "MultiDiscrete", _multi_discrete),
            ("multi_binary", "MultiBinary", _multi_binary),
        )
    },
    Name(f"{_SB3}.noise", "NormalActionNoise"): _object(_normal_noise),
    Name(f"{_SB3}.noise", "OrnsteinUhlenbeckActionNoise"): _object(_ornstein_uhlenbeck_noise),
    Name(f"{_SB3}.noise", "VectorizedActionNoise"): _object(_base_noise),
    Name("sb3_tdc.common.noise", "NormalNoiseRange"): _object(_noise_range),
    Name("sb3_tdc.common.noise", "VectorizedNormalNoise"): _object(_base_noise),
    Name(f"{_SB3}.utils", "LinearSchedule"): _object(_linear_schedule),
    Name(f"{_SB3}.utils", "ConstantSchedule"): _object(_constant_schedule),
    Name(f"{_SB3}.utils", "FloatSchedule"): _object(_float_schedule),
    Name("rl_zoo3.utils", "SimpleLinearSchedule"): _object(_zoo_schedule),
    Name(f"{_SB3}.running_mean_std", "RunningMeanStd"): _object(_running_mean_std),
    Name(f"{_SB3}.type_aliases", "TrainFreq"): Handler(_train_freq, args=(2, 2)),
    **dict.fromkeys(_ENUMS, Handler(_enum_of_value, args=(1, 1))),
    Name("builtins", "getattr"): Handler(_enum_of_name, args=(2, 2), only=_is_member),
}
# For each name, the function that returns whether its handler accepts a call
TAKEN: dict[Name, Callable[[Call], bool]] = {name: handler.takes for name, handler in CALLS.items()}
