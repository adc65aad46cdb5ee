"""Pickled fields that hang a reader, fill its memory, or control the terminal that shows the refusal."""

import base64
import json
import math
import os

from stable_baselines3 import TD3
from stable_baselines3.common.envs import SimpleMultiObsEnv

from tests.safe_load.attacks.tools import Op, fields_of, pickled, rewrite, with_fields

FIELDS = (
    *("policy_class", "policy_kwargs", "observation_space", "action_space", "learning_rate", "lam", "action_noise"),
    *("train_freq", "replay_buffer_class", "replay_buffer_kwargs", "ent_coef", "seed", "gamma", "num_timesteps"),
)


def doubled(container: bytes = Op.EMPTY_LIST, add: bytes = Op.APPENDS, times: int = 50) -> bytes:
    """A list of two references to a list of two references to …: 2**50 values in some hundred bytes."""
    raw = Op.PROTO + container + Op.put(0)
    for i in range(times):
        raw += container + Op.put(i + 1) + Op.MARK + Op.get(i) + Op.get(i) + add
    return raw + Op.STOP


def doubled_tuples() -> bytes:
    raw = Op.PROTO + Op.EMPTY_TUPLE + Op.put(0)
    for i in range(50):
        raw += Op.tuple_of(Op.get(i), Op.get(i)) + Op.put(i + 1)
    return raw + Op.STOP


def doubled_dicts() -> bytes:
    raw = Op.PROTO + Op.EMPTY_DICT + Op.put(0)
    for i in range(50):
        raw += (
            Op.EMPTY_DICT + Op.put(i + 1) + Op.MARK + Op.text("a") + Op.get(i) + Op.text("b") + Op.get(i) + Op.SETITEMS
        )
    return raw + Op.STOP


def colliding(n: int = 60_000) -> bytes:
    """Keys whose hashes are all the same: multiples of the modulus of Python's hash of integers."""
    keys = b"".join(_long(i * (2**61 - 1)) + Op.NONE for i in range(1, n))
    return Op.PROTO + Op.EMPTY_DICT + Op.MARK + keys + Op.SETITEMS + Op.STOP


def _long(value: int) -> bytes:
    raw = value.to_bytes((value.bit_length() + 8) // 8, "little", signed=True)
    return b"\x8a" + bytes([len(raw)]) + raw


def many_operations() -> bytes:
    return Op.PROTO + (Op.NONE + Op.POP) * 5_000_000 + Op.NONE + Op.STOP


def large_integer() -> bytes:
    return Op.PROTO + b"\x8b" + (2**22).to_bytes(4, "little") + b"\x7f" * 2**22 + Op.STOP


def long_name() -> bytes:
    return Op.PROTO + Op.name("m" * 10**7, "\x1b[2J\x1b]0;owned\x07") + Op.STOP


def colliding_in_a_set() -> bytes:
    keys = b"".join(_long(i * (2**61 - 1)) for i in range(1, 60_000))
    return b"\x80\x04" + b"\x8f" + Op.MARK + keys + b"\x90" + Op.STOP


def colliding_in_appended_pairs(n: int = 20_000) -> bytes:
    """The keys of an ``OrderedDict`` as pairs that are appended to it, not set in it."""
    keys = b"".join(_long(i * (2**61 - 1)) + Op.NONE + b"\x86" for i in range(1, n))
    mapping = Op.name("collections", "OrderedDict") + Op.EMPTY_TUPLE + Op.REDUCE
    return Op.PROTO + mapping + Op.MARK + keys + Op.APPENDS + Op.STOP


def text_as_key() -> bytes:
    return Op.PROTO + Op.EMPTY_DICT + Op.text("\x1b[31m" + "k" * 10**7) + Op.NONE + Op.SETITEM + Op.STOP


def array(content: bytes, kind: str, *shape: int) -> bytes:
    dtype = Op.name("numpy", "dtype") + Op.tuple_of(Op.text(kind), Op.FALSE, Op.TRUE) + Op.REDUCE
    raw = b"B" + len(content).to_bytes(4, "little") + content
    arguments = Op.tuple_of(raw, dtype, Op.tuple_of(*map(Op.integer, shape)), Op.text("C"))
    return Op.name("numpy._core.numeric", "_frombuffer") + arguments + Op.REDUCE


def with_state(name: bytes, **attributes: bytes) -> bytes:
    """The opcodes of an object that is made without arguments, and given its attributes."""
    state = b"".join(Op.text(attribute) + value + Op.SETITEM for attribute, value in attributes.items())
    return name + Op.EMPTY_TUPLE + b"\x81" + Op.EMPTY_DICT + state + Op.BUILD


def dict_space(box: bytes, n: int) -> bytes:
    parts = b"".join(Op.text(f"{i}") + box for i in range(n))
    return with_state(Op.name("gymnasium.spaces.dict", "Dict"), spaces=Op.EMPTY_DICT + Op.MARK + parts + Op.SETITEMS)


_BOX = Op.name("gymnasium.spaces.box", "Box")


def boxes_of_one_array(n: int = 60, size: int = 6_000_000) -> bytes:
    """One array, and many spaces that each copy it."""
    box = with_state(_BOX, low=Op.get(1), high=Op.get(1))
    return Op.PROTO + array(bytes(size), "f4", size // 4) + Op.put(1) + Op.POP + dict_space(box, n) + Op.STOP


_MULTI_DISCRETE = Op.name("gymnasium.spaces.multi_discrete", "MultiDiscrete")
_CONSTANT_SCHEDULE = Op.name("stable_baselines3.common.utils", "ConstantSchedule")
_NORMAL = Op.name("stable_baselines3.common.noise", "NormalActionNoise")
_ORNSTEIN_UHLENBECK = Op.name("stable_baselines3.common.noise", "OrnsteinUhlenbeckActionNoise")


def texts(n: int, length: int = 10**6) -> bytes:
    """The opcodes of a list of n times the same text, which messages would show and NumPy would parse."""
    first = Op.text("1" * length) + Op.put(1) + Op.POP
    return Op.EMPTY_LIST + first + Op.MARK + Op.get(1) * n + Op.APPENDS


def one_text_as(name: bytes, attribute: str, n: int, **others: bytes) -> bytes:
    return Op.PROTO + with_state(name, **{attribute: texts(n)}, **others) + Op.STOP


def quantiles_of_texts() -> bytes:
    """Lists that are short enough to be an argument of a network."""
    lists = texts(60) + Op.put(2) + Op.POP + Op.EMPTY_LIST + Op.MARK + Op.get(2) * 5 + Op.APPENDS + Op.put(3) + Op.POP
    return Op.PROTO + lists + Op.EMPTY_DICT + Op.text("n_quantiles") + Op.get(3) + Op.SETITEM + Op.STOP


def copies_of_one_array(name: bytes, shared: tuple[str, ...], size: int, **others: bytes) -> bytes:
    """A thousand objects of one state, each of which converts the same array of one-byte numbers."""
    state = {**dict.fromkeys(shared, Op.get(1)), **others}
    first = with_state(name, **state)[: -len(Op.BUILD)] + Op.put(2) + Op.BUILD
    more = (name + Op.EMPTY_TUPLE + b"\x81" + Op.get(2) + Op.BUILD) * 1000
    numbers = array(b"\1" * size, "u1", size) + Op.put(1) + Op.POP
    return Op.PROTO + numbers + Op.EMPTY_LIST + Op.MARK + first + more + Op.APPENDS + Op.STOP


def choices_of_one_array(size: int = 2**16) -> bytes:
    return copies_of_one_array(_MULTI_DISCRETE, ("nvec",), size)


def noise_of_one_array(size: int = 10**5) -> bytes:
    numbers = dict.fromkeys(("_theta", "_dt"), Op.integer(1))
    return copies_of_one_array(_ORNSTEIN_UHLENBECK, ("_mu", "_sigma"), size, **numbers, initial_noise=Op.NONE)


def noise_of_other_actions(mean: tuple[int, ...], sigma: tuple[int, ...], n_envs: int):
    """Return a ``make`` for a model of many environments, whose noise has a mean and a sigma of these shapes."""
    parts = {name: array(b"\1" * math.prod(shape), "u1", *shape) for name, shape in (("_mu", mean), ("_sigma", sigma))}
    raw = Op.PROTO + with_state(_NORMAL, **parts) + Op.STOP
    return lambda folder, model: with_fields(model, folder / "x.zip", action_noise=pickled(raw), n_envs=n_envs)


def images_of_many_names(n: int = 900) -> bytes:
    """One image under many names: a network is built for every name."""
    size = (1, 36, 36)
    box = with_state(_BOX, low=array(bytes(36**2), "u1", *size), high=array(b"\xff" * 36**2, "u1", *size))
    return Op.PROTO + box + Op.put(1) + Op.POP + dict_space(Op.get(1), n) + Op.STOP


def many_images(folder, model):
    learned = TD3("MultiInputPolicy", SimpleMultiObsEnv(discrete_actions=False), buffer_size=10, device="cpu")
    learned.save(folder / "dict.zip")
    return with_fields(folder / "dict.zip", folder / "x.zip", observation_space=pickled(images_of_many_names()))


def noise_of_doubled_lists() -> bytes:
    """A mean of lists doubled only 26 times: NumPy could make an array of them, slowly."""
    lists = doubled(times=26)[: -len(Op.STOP)] + Op.POP * 27
    state = Op.EMPTY_DICT + Op.MARK + Op.text("_mu") + Op.get(26) + Op.text("_sigma") + Op.integer(1) + Op.SETITEMS
    noise = Op.name("stable_baselines3.common.noise", "NormalActionNoise") + Op.EMPTY_TUPLE + b"\x81"
    return lists + noise + state + Op.BUILD + Op.STOP


def of_bytes(field: str, name: bytes, *attributes: str, size: int = 40_000_000):
    """
    Return a ``make`` for an object that holds one array of one-byte numbers and converts it to eight-byte ones.

    The file has 1 MB.
    """

    def make(folder, model):
        numbers = array(b"\1" * size, "u1", size) + Op.put(1) + Op.POP
        raw = Op.PROTO + numbers + with_state(name, **dict.fromkeys(attributes, Op.get(1))) + Op.STOP
        noise = base64.b64encode(
            os.urandom(size // 60)
        ).decode()  # without it, the ones would be compressed more than a hundredfold, and refused
        data = {**fields_of(model), field: pickled(raw), "tensorboard_log": noise}
        return rewrite(model, folder / "x.zip", deflate=True, data=json.dumps(data))

    return make


noise_of_bytes = of_bytes(
    "action_noise", Op.name("sb3_tdc.common.noise", "NormalNoiseRange"), "_mu", "smallest", "largest"
)
choices_of_bytes = of_bytes("observation_space", _MULTI_DISCRETE, "nvec")
RAW = {
    "lists doubled": doubled,
    "tuples doubled": doubled_tuples,
    "dicts doubled": doubled_dicts,
    "colliding keys": colliding,
    "colliding keys in a set": colliding_in_a_set,
    "colliding keys in appended pairs": colliding_in_appended_pairs,
    "ten million operations": many_operations,
    "an integer of four million bytes": large_integer,
    "a name of ten million letters that clears the screen": long_name,
    "a key of ten million letters": text_as_key,
}
ATTACKS = {
    **{
        f"{name} in {field}": lambda folder, model, raw=raw, field=field: with_fields(
            model, folder / "x.zip", **{field: pickled(raw())}
        )
        for name, raw in RAW.items()
        for field in (FIELDS if name.endswith("doubled") else ("policy_kwargs", "_last_obs"))
    },
    "noise whose mean is lists doubled": lambda folder, model: with_fields(
        model, folder / "x.zip", action_noise=pickled(noise_of_doubled_lists())
    ),
    "noise of forty million bytes": noise_of_bytes,
    "a MultiDiscrete of forty million bytes": choices_of_bytes,
    "noise of four thousand actions in ten thousand environments": noise_of_other_actions((4000,), (4000,), 10_000),
    "noise that broadcasts to four million actions": noise_of_other_actions((2000, 1), (1, 2000), 8),
    "nine hundred names of an image": many_images,
    **{
        f"one long text many times as {what}": lambda folder, model, field=field, raw=raw: with_fields(
            model, folder / "x.zip", **{field: pickled(raw())}
        )
        for what, field, raw in (
            ("a schedule", "learning_rate", lambda: one_text_as(_CONSTANT_SCHEDULE, "val", 300)),
            ("the mean of noise", "action_noise", lambda: one_text_as(_NORMAL, "_mu", 5000, _sigma=Op.integer(1))),
            ("n_quantiles", "policy_kwargs", quantiles_of_texts),
        )
    },
    "a thousand MultiDiscretes of one array": lambda folder, model: with_fields(
        model, folder / "x.zip", observation_space=pickled(choices_of_one_array())
    ),
    "a thousand noises of one array": lambda folder, model: with_fields(
        model, folder / "x.zip", action_noise=pickled(noise_of_one_array())
    ),
    "sixty boxes of one array": lambda folder, model: with_fields(
        model, folder / "x.zip", observation_space=pickled(boxes_of_one_array())
    ),
}
