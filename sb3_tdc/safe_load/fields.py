"""The fields of a saved model: which there are, what each may be, and what is taken from nowhere but a new model."""

import base64
import json
import math
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from gymnasium import spaces
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.her import HerReplayBuffer

from sb3_tdc.advb import AdvBSAC, AdvBTD3, AdvBTDC
from sb3_tdc.hyperparams import POLICY_ARGUMENTS, constructor_hints
from sb3_tdc.meow import MEOW
from sb3_tdc.safe_load.budget import Budget, UnsafeFileError, shown
from sb3_tdc.safe_load.checks import boolean, integer, is_plain, number, reading
from sb3_tdc.safe_load.inert_pickle import Name, Rebuild, names_in, read_pickle
from sb3_tdc.safe_load.known_objects import CALLS, CLASSES, name_of
from sb3_tdc.tdc import TDC

MAX_REPLAY_BYTES = 2**36  # of the replay buffer that a loaded model gets
MAX_HER_SLOTS = 2_000_000
MAX_CRITICS = 256
MAX_ENVS = 10_000
# What is made of the argument ent_coef
TEMPERATURE = ("log_ent_coef", "ent_coef_optimizer", "ent_coef_tensor")


def known_policies() -> dict[Any, type[OffPolicyAlgorithm]]:
    """The known policy classes, and the algorithm of each."""
    algorithms: list[type[OffPolicyAlgorithm]] = [TDC, MEOW, AdvBTD3, AdvBSAC, AdvBTDC, TD3, SAC]
    with suppress(ImportError):  # contrib is an extra
        from sb3_contrib import TQC

        algorithms.append(TQC)
    return {policy: algorithm for algorithm in algorithms for policy in algorithm.policy_aliases.values()}


def nearest_algorithm(policy_class: Any) -> type[OffPolicyAlgorithm] | None:
    """The algorithm of a policy of the caller's own, which custom_objects gave."""
    bases = policy_class.__mro__ if isinstance(policy_class, type) else ()
    return next((algorithm for base, algorithm in known_policies().items() if base in bases), None)


def _instance(*kinds: type) -> Callable[[str, Any], Any]:
    def check(name: str, value: Any) -> Any:
        if isinstance(value, bool) or not isinstance(value, kinds):
            raise ValueError(f"{name} must be a {' or '.join(k.__name__ for k in kinds)}, got {shown(value)}")
        return value

    return check


def _schedule(name: str, value: Any) -> Any:
    return value if callable(value) and not isinstance(value, type) else number(0.0)(name, value)


def _text_or_number(name: str, value: Any) -> Any:
    return value if isinstance(value, str) and len(value) < 100 else number()(name, value)


def _noise(name: str, value: Any) -> Any:
    return value if isinstance(value, ActionNoise) else number(0.0)(name, value)


def _subclass(base: type) -> Callable[[str, Any], Any]:
    def check(name: str, value: Any) -> Any:
        if not isinstance(value, type) or not issubclass(value, base):
            raise ValueError(f"{name} must be a {base.__name__} class, got {shown(value)}")
        return value

    return check


def _train_freq(name: str, value: Any) -> Any:
    if isinstance(value, TrainFreq):
        return value
    if isinstance(value, list) and len(value) == 2 and value[1] in ("step", "episode"):
        return (integer(1)(name, value[0]), value[1])
    return integer(1)(name, value)


def _arguments(name: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value) or not is_plain(value):
        raise ValueError(f"{name} must be a mapping of names to finite numbers, texts and known classes")
    for counted in ("n_critics", "n_blocks", "n_members"):  # so many networks are built before anything is compared
        if value.get(counted) is not None:
            integer(1, MAX_CRITICS)(counted, value[counted])
    return value


def _none(name: str, value: Any) -> None:
    if value is not None:
        raise ValueError(f"{name} must be null, got {shown(value)}")


def _or_none(check: Callable[[str, Any], Any]) -> Callable[[str, Any], Any]:
    return lambda name, value: None if value is None else check(name, value)


# Every field that is taken from a file, and what it may be
_FIELDS: dict[str, Callable[[str, Any], Any]] = {
    "policy_class": _subclass(BasePolicy),
    "policy_kwargs": _arguments,
    "observation_space": _instance(spaces.Space),
    "action_space": _instance(spaces.Box),
    "learning_rate": _schedule,
    "lam": _schedule,
    "qf_learning_rate": _or_none(_schedule),
    "action_noise": _or_none(_noise),
    "train_freq": _train_freq,
    "replay_buffer_class": _or_none(_subclass(ReplayBuffer)),
    "replay_buffer_kwargs": _arguments,
    "ent_coef": _text_or_number,
    "target_entropy": _or_none(_text_or_number),
    "seed": _or_none(integer(0)),
    "fused": _or_none(boolean),
    "verbose": integer(0, 2),
    "n_envs": integer(1, MAX_ENVS),
    **dict.fromkeys(TEMPERATURE, _none),  # where there is one, it is a tensor, and elsewhere in the file
    **dict.fromkeys(("gradient_steps", "sde_sample_freq"), integer(-1)),
    **dict.fromkeys(("buffer_size", "batch_size", "n_steps", "policy_delay", "target_update_interval"), integer(1)),
    **dict.fromkeys(
        (
            *("num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "_episode_num", "_n_updates"),
            *("learning_starts", "formation_period", "_stats_window_size", "top_quantiles_to_drop_per_net"),
        ),
        integer(0),
    ),
    "gamma": number(0.0, 1.0),
    "tau": number(maximum=1.0, above=0.0),
    "kappa": number(above=0.0),
    "_current_progress_remaining": number(-1.0, 1.0),
    **dict.fromkeys(("target_policy_noise", "target_noise_clip", "max_grad_norm"), number(0.0)),
    **dict.fromkeys(
        (
            *("use_sde", "use_sde_at_warmup", "optimize_memory_usage", "stochastic_actor", "_built_stochastic_actor"),
            *("remove_time_limit_termination",),
        ),
        boolean,
    ),
}  # fmt: skip
# What is made anew when a model is set up or learns; the file's is not looked at
_MADE_ANEW = {
    "lr_schedule", "start_time", "ep_info_buffer", "ep_success_buffer", "_last_obs", "_last_original_obs",
    "_last_episode_starts", "_last_dones", "tensorboard_log", "device", "env", "eval_env",
    "create_eval_env", "_logger", "_custom_logger", "_vec_normalize_env", "replay_buffer", "sde_support",
    *(f"{of}batch_norm_stats{target}" for of in ("", "actor_", "critic_") for target in ("", "_target")),
}  # fmt: skip


def read_fields(raw: bytes, custom_objects: dict[str, Any], budget: Budget) -> dict[str, Any]:
    """
    :param budget: of the file
    :return: the fields of ``data`` that are known, each checked; those of ``custom_objects`` as they are given
    :raises UnsafeFileError: for any other, by name
    """
    data = parse_data(raw)
    classes = {**CLASSES, **{name_of(policy): policy for policy in known_policies()}}
    fields = {}
    for name, value in data.items():
        if name in custom_objects:
            fields[name] = custom_objects[name]
        elif name in _FIELDS:
            with reading(f"the field {name} (custom_objects can replace it)"):
                if isinstance(value, dict) and ":serialized:" in value:
                    value = Rebuild(classes, CALLS, budget)(_pickled(value, budget))
                fields[name] = _FIELDS[name](name, value)
        elif name not in _MADE_ANEW:
            raise UnsafeFileError(f"the field {shown(name)} is unknown (custom_objects can replace it)")
    _warn_of_code(data, custom_objects, budget)
    known = constructor_hints(fields.get("policy_class", BasePolicy)).keys() - POLICY_ARGUMENTS
    fields.setdefault("policy_kwargs", {}).pop("device", None)
    for name in fields["policy_kwargs"]:
        if name not in known:
            raise UnsafeFileError(f"the field policy_kwargs has the unknown key {shown(name)}")
    return fields


def _pickled(value: Any, budget: Budget) -> Any:
    """:return: what :func:`read_pickle` makes of a pickled field"""
    text = value[":serialized:"]
    if not isinstance(text, str):
        raise UnsafeFileError("its pickle is not a text")
    budget.take_bytes(len(text))
    return read_pickle(base64.b64decode(text, validate=True), budget)


def foreign_names(value: Any, budget: Budget) -> list[str]:
    """
    :param value: a field of ``data``
    :return: what SB3's ``load`` would import or call for it that is not known to be harmless, sorted
    """
    if not (isinstance(value, dict) and ":serialized:" in value):
        return []
    policies = {name_of(policy) for policy in known_policies()}
    known = {*CLASSES, *CALLS, *policies, *_HARMLESS}
    return sorted(str(name) for name in names_in(_pickled(value, budget)) if name not in known)


# What SB3 and numpy write into fields that are made anew, and into attributes that are not looked at
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
                f"The field {shown(name)} is not read here, but SB3's load would run code for it: "
                f"{', '.join(found[:3])}{' …' if len(found) > 3 else ''}",
                RuntimeWarning,
                stacklevel=2,
            )


# Brackets and commas of JSON: SB3 writes some thousands, most of them inside texts
_MAX_JSON = 500_000


def parse_data(raw: bytes) -> dict[str, Any]:
    """:raises UnsafeFileError: unless it is a mapping of JSON, each key once, of a reasonable number of values"""
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


# What SB3 writes of every off-policy algorithm, and of each; without one, a default would be taken for it in silence
REQUIRED = (
    *("policy_class", "learning_rate", "gamma", "tau", "batch_size", "buffer_size", "learning_starts", "train_freq"),
    *("gradient_steps", "num_timesteps", "_n_updates", "_episode_num", "seed", "action_noise", "use_sde"),
    *("optimize_memory_usage", "replay_buffer_class", "replay_buffer_kwargs"),
)
_OF_TD3 = ("policy_delay", "target_policy_noise", "target_noise_clip")
_OF_SAC = ("ent_coef", "target_entropy", "target_update_interval")
REQUIRED_OF: dict[str, tuple[str, ...]] = {
    "TD3": _OF_TD3,
    "SAC": _OF_SAC,
    "TQC": (*_OF_SAC, "top_quantiles_to_drop_per_net"),
    "MEOW": ("ent_coef",),
    "TDC": (*_OF_TD3, "lam", "kappa", "qf_learning_rate", "stochastic_actor", "ent_coef", "target_entropy"),
}


def check_complete(fields: dict[str, Any], algorithm: type[OffPolicyAlgorithm]) -> None:
    """
    :param algorithm: that the policy is of
    :raises UnsafeFileError: if a field is missing that SB3 always writes
    """
    for name in (*REQUIRED, *REQUIRED_OF.get(algorithm.__name__, ())):
        if name not in fields:
            raise UnsafeFileError(f"the field {name} is missing (custom_objects can give it)")


def is_her(fields: dict[str, Any]) -> bool:
    """Whether the model gets a replay buffer with hindsight."""
    kind = fields.get("replay_buffer_class")
    return isinstance(kind, type) and issubclass(kind, HerReplayBuffer)


def check_replay_memory(fields: dict[str, Any]) -> None:
    size, observations = fields.get("buffer_size", 1), fields["observation_space"]
    if is_her(fields) and size > MAX_HER_SLOTS:  # it makes a dict for every one of them
        raise UnsafeFileError(
            f"its HerReplayBuffer of {size:,} transitions takes more memory than it should: give a smaller buffer_size"
        )
    parts: Any = observations.spaces.values() if isinstance(observations, spaces.Dict) else [observations]
    n_bytes = size * sum(2 * math.prod(part.shape) * part.dtype.itemsize for part in parts)
    if n_bytes > MAX_REPLAY_BYTES:
        raise UnsafeFileError(
            f"its replay buffer of {size:,} transitions takes {n_bytes / 2**30:,.0f} GiB: give a smaller buffer_size"
        )
