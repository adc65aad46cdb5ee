"""The fields of a saved model: those that are known, their allowed values, and those that are always created anew."""

import base64
import json
import math
import re
import warnings
from contextlib import suppress
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.her import HerReplayBuffer

from sb3_tdc.algorithms import ALGORITHMS
from sb3_tdc.common.saved_fields import SavedField
from sb3_tdc.common.untrusted import shown
from sb3_tdc.common.words import count
from sb3_tdc.hyperparams import POLICY_ARGUMENTS, constructor_hints
from sb3_tdc.safe_load.budget import Budget, UnsafeFileError
from sb3_tdc.safe_load.inert_pickle import Call, Name, Rebuild, code_in, read_pickle
from sb3_tdc.safe_load.known_objects import CALLS, CLASSES, TAKEN, pickled_name
from sb3_tdc.safe_load.reading import reading
from sb3_tdc.safe_load.sb3_fields import OF_SB3, OFF_POLICY

MAX_REPLAY_BYTES = 2**36  # size of a loaded model's replay buffer, and of a pickle file
MAX_HER_SLOTS = 2_000_000
# Attributes that are created from the argument ent_coef
TEMPERATURE = ("log_ent_coef", "ent_coef_optimizer", "ent_coef_tensor")


def known_policies() -> dict[Any, type[OffPolicyAlgorithm]]:
    """Return the algorithm of each known policy class; TD3 for the classes that TD3 and DDPG share."""
    algorithms = list(ALGORITHMS.values())
    with suppress(ImportError):  # contrib is an extra
        from sb3_contrib import TQC

        algorithms.append(TQC)
    return {policy: algorithm for algorithm in algorithms[::-1] for policy in algorithm.policy_aliases.values()}


def saved_fields(algorithm: type[OffPolicyAlgorithm]) -> dict[str, SavedField]:
    """
    Return the fields that an algorithm saves, by name; those of ``policy_kwargs`` as ``policy_kwargs.<name>``.

    :param algorithm: algorithm class; it and its bases declare their own fields in ``saved_fields``
    """
    fields = dict(OFF_POLICY)
    for base in reversed(algorithm.__mro__):
        fields |= OF_SB3.get(f"{base.__module__}.{base.__qualname__}", {}) | vars(base).get("saved_fields", {})
    return fields


def nearest_algorithm(policy_class: Any) -> type[OffPolicyAlgorithm] | None:
    """Return the algorithm of the known policy that a custom policy (of ``custom_objects``) inherits from, or None."""
    bases = policy_class.__mro__ if isinstance(policy_class, type) else ()
    return next((algorithm for base, algorithm in known_policies().items() if base in bases), None)


# Fields that are created again when a model is set up or learns; the file's values are not used
_MADE_ANEW = {
    "lr_schedule", "start_time", "ep_info_buffer", "ep_success_buffer", "_last_obs", "_last_original_obs",
    "_last_episode_starts", "_last_dones", "tensorboard_log", "device", "env", "eval_env",
    "create_eval_env", "_logger", "_custom_logger", "_vec_normalize_env", "replay_buffer", "sde_support",
    *(f"{of}batch_norm_stats{target}" for of in ("", "actor_", "critic_") for target in ("", "_target")),
}  # fmt: skip


def read_fields(
    data: dict[str, Any],
    custom_objects: dict[str, Any],
    budget: Budget,
    algorithm: type[OffPolicyAlgorithm] | None = None,
) -> tuple[dict[str, Any], type[OffPolicyAlgorithm]]:
    """
    Read the fields of a saved model.

    :param data: the fields as :func:`parse_data` returns them
    :param custom_objects: values by field name that replace those of the file, which are then not used, or are missing
    :param budget: of the file
    :param algorithm: the algorithm that must have saved the file, or a subclass of it; None for the algorithm of the
        file's policy
    :return: the known fields, each checked, and the algorithm
    :raises UnsafeFileError: if a field is unknown, missing or not allowed (the error names it), or if another algorithm
        saved the file
    """
    policies = known_policies()
    make = Rebuild({**CLASSES, **{pickled_name(policy): policy for policy in policies}}, CALLS, budget)
    policy_class = custom_objects.get("policy_class")
    if policy_class is None and "policy_class" in data:
        policy_class = _read_field("policy_class", data["policy_class"], OFF_POLICY["policy_class"], make)
    saved_by = policies.get(policy_class) or nearest_algorithm(policy_class)
    if saved_by is None:
        known = sorted({each.__name__ for each in policies.values()})
        raise UnsafeFileError(f"it has no policy_class of {', '.join(known)}")
    algorithm = algorithm or saved_by
    if not issubclass(algorithm, saved_by):
        raise UnsafeFileError(f"it was saved by {saved_by.__name__}, not by {algorithm.__name__}")
    declared = saved_fields(algorithm)
    fields = {name: value for name, value in custom_objects.items() if name in data or name in declared}
    for name, value in data.items():
        if name in fields:
            continue
        if name in declared:
            fields[name] = _read_field(name, value, declared[name], make)
        elif name not in _MADE_ANEW:
            raise UnsafeFileError(f"the field {shown(name)} is unknown (custom_objects can replace it)")
    _warn_of_code(data, custom_objects, budget)
    fields.setdefault("policy_kwargs", {}).pop("device", None)
    _check_policy_arguments(fields["policy_kwargs"], policy_class, declared)
    for name, field in declared.items():
        if field.is_required and name not in fields:
            raise UnsafeFileError(f"the field {name} is missing (custom_objects can give it)")
    return fields, algorithm


_REMEDY = re.compile(r"\(custom_objects can \w+ it\)")


def on_the_command_line(sentence: str) -> str:
    """Return a refusal that suggests ``--trust`` instead of ``custom_objects``, which is not a flag of the commands."""
    return _REMEDY.sub("(if you know its origin, enjoy, evaluate and train open it with --trust)", sentence)


def _read_field(name: str, value: Any, declared: SavedField, make: Rebuild) -> Any:
    with reading(f"the field {name} (custom_objects can replace it)"):
        if isinstance(value, dict) and ":serialized:" in value:
            value = make(_pickled(value, make.budget))
        return declared.check(name, value)


def _check_policy_arguments(arguments: dict[str, Any], policy_class: Any, declared: dict[str, SavedField]) -> None:
    known = constructor_hints(policy_class).keys() - POLICY_ARGUMENTS
    for name, value in arguments.items():
        if name not in known:
            raise UnsafeFileError(f"the field policy_kwargs has the unknown key {shown(name)}")
        field = declared.get(f"policy_kwargs.{name}")
        if field is not None and value is not None:
            with reading("the field policy_kwargs (custom_objects can replace it)"):
                field.check(name, value)


def _pickled(value: Any, budget: Budget, noted: list[Name | Call] | None = None) -> Any:
    """Read a pickled field with :func:`read_pickle`."""
    text = value[":serialized:"]
    if not isinstance(text, str):
        raise UnsafeFileError("its pickle is not a text")
    budget.take_bytes(len(text))
    return read_pickle(base64.b64decode(text, validate=True), budget, noted)


def foreign_names(value: Any, budget: Budget) -> list[str]:
    """
    List the code that SB3's ``load`` would run for a field.

    :param value: a field of ``data``
    :return: the names that SB3's ``load`` would import or call for it, except those known to be harmless; sorted
    """
    if not (isinstance(value, dict) and ":serialized:" in value):
        return []
    noted: list[Name | Call] = []
    _pickled(value, budget, noted)
    names = {*CLASSES, *map(pickled_name, known_policies())}
    return code_in(noted, names, {**dict.fromkeys(_HARMLESS, lambda _: True), **TAKEN})


# Names that SB3 and numpy write into fields that are created again, and into attributes that are not used
_HARMLESS = {
    *(Name("collections", kind) for kind in ("deque", "defaultdict", "Counter")),
    *(Name("builtins", kind) for kind in ("set", "frozenset", "complex", "bytearray")),
    *(Name("numpy", kind) for kind in ("ndarray", "float32", "float64", "int64", "uint8")),
    *(Name("numpy.random._pickle", f"__{kind}_ctor") for kind in ("generator", "bit_generator", "randomstate")),
    *(Name("numpy.random._pcg64", "PCG64"), Name("numpy.random._mt19937", "MT19937")),
    *(Name("numpy.random.bit_generator", kind) for kind in ("SeedSequence", "__pyx_unpickle_SeedSequence")),
    *(Name("pathlib", kind) for kind in ("PosixPath", "WindowsPath")),
    Name("torch", "device"),
}


def _warn_of_code(data: dict[str, Any], custom_objects: dict[str, Any], budget: Budget) -> None:
    for name in [name for name in data if name in _MADE_ANEW or name in custom_objects]:
        try:
            found = foreign_names(data[name], budget)
        except (UnsafeFileError, ValueError) as error:
            found = [f"something that cannot be read ({error})"]
        if found:
            warnings.warn(
                f"The field {shown(name)} is not used here, but SB3's load would run code for it: "
                f"{', '.join(found[:3])}{' …' if len(found) > 3 else ''}",
                RuntimeWarning,
                stacklevel=2,
            )


# Limit on the brackets and commas of the JSON: SB3 writes a few thousand, most of them inside strings
_MAX_JSON = 500_000


def parse_data(raw: bytes) -> dict[str, Any]:
    """
    Parse the entry ``data``.

    :raises UnsafeFileError: unless it is a JSON mapping with unique keys and a reasonable number of values
    """
    with reading("data"):
        if sum(map(raw.count, (b"[", b"{", b","))) > _MAX_JSON:
            raise UnsafeFileError("it has too many values")
        data = json.loads(raw, object_pairs_hook=_unique)
        if not isinstance(data, dict):
            raise UnsafeFileError("it does not hold fields")
        return data


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len({name for name, _ in pairs}) != len(pairs):
        raise UnsafeFileError("it has a field twice")
    return dict(pairs)


def is_her(fields: dict[str, Any]) -> bool:
    """Return whether the model's replay buffer is a ``HerReplayBuffer``, which replays with hindsight."""
    kind = fields.get("replay_buffer_class")
    return isinstance(kind, type) and issubclass(kind, HerReplayBuffer)


def check_noise(fields: dict[str, Any], budget: Budget) -> None:
    """
    Check the action noise of a file, which a model copies for each of its environments.

    :raises UnsafeFileError: if the noise is not of the actions, or if the copies take more memory than the budget has
    """
    noise, n_actions = fields["action_noise"], math.prod(fields["action_space"].shape)
    parts = vars(noise).values() if isinstance(noise, ActionNoise) else ()
    arrays = [part for part in parts if isinstance(part, np.ndarray)]
    with reading("the field action_noise (custom_objects can replace it)"):
        size = math.prod(np.broadcast_shapes(*(part.shape for part in arrays)))
        if size not in (1, n_actions):
            raise UnsafeFileError(f"noise of {count(size, 'number')} for {count(n_actions, 'action')}")
        # A number becomes a mean and a standard deviation of every action
        n_bytes = 0 if noise is None else np.dtype(float).itemsize * max(len(arrays), 2) * n_actions
        budget.take_bytes(fields.get("n_envs", 1) * n_bytes)


def check_replay_memory(fields: dict[str, Any]) -> None:
    # SB3 makes room for at least one transition of each environment
    size = max(fields.get("buffer_size", 1), fields.get("n_envs", 1))
    observations, actions = fields["observation_space"], fields["action_space"]
    if is_her(fields) and size > MAX_HER_SLOTS:  # it allocates a dict for each transition
        raise UnsafeFileError(
            f"its HerReplayBuffer of {size:,} transitions takes more memory than it should: give a smaller buffer_size"
        )
    parts: Any = observations.spaces.values() if isinstance(observations, spaces.Dict) else [observations]
    n_bytes = size * sum(math.prod(part.shape) * part.dtype.itemsize for part in (*parts, *parts, actions))
    if n_bytes > MAX_REPLAY_BYTES:
        raise UnsafeFileError(
            f"its replay buffer of {size:,} transitions takes {n_bytes / 2**30:,.0f} GiB: "
            "give a smaller buffer_size or n_envs"
        )
