"""The fields of a saved model: which there are, what each may be, and what is taken from nowhere but a new model."""

import base64
import json
import math
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

from sb3_tdc.hyperparams import POLICY_ARGUMENTS, constructor_hints
from sb3_tdc.safe_load.checks import boolean, integer, is_plain, reading
from sb3_tdc.safe_load.inert_pickle import UnsafeFileError, read_pickle, rebuild
from sb3_tdc.safe_load.known_objects import CALLS, CLASSES, name_of
from sb3_tdc.tdc import TDC
from sb3_tdc.tdc.checks import check_number

MAX_REPLAY_BYTES = 2**36  # of the replay buffer that a loaded model gets
MAX_CRITICS = 256
MAX_ENVS = 10_000
# What is made of the argument ent_coef
TEMPERATURE = ("log_ent_coef", "ent_coef_optimizer", "ent_coef_tensor")


def known_policies() -> dict[Any, type[OffPolicyAlgorithm]]:
    """The known policy classes, and the algorithm of each."""
    algorithms: list[type[OffPolicyAlgorithm]] = [TDC, TD3, SAC]
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
            raise ValueError(f"{name} must be a {' or '.join(k.__name__ for k in kinds)}, got {value!r:.100}")
        return value

    return check


def _schedule(name: str, value: Any) -> Any:
    return value if callable(value) and not isinstance(value, type) else check_number(name, value, 0.0)


def _text_or_number(name: str, value: Any) -> Any:
    return value if isinstance(value, str) and len(value) < 100 else check_number(name, value)


def _noise(name: str, value: Any) -> Any:
    return value if isinstance(value, ActionNoise) else check_number(name, value, 0.0)


def _subclass(base: type) -> Callable[[str, Any], Any]:
    def check(name: str, value: Any) -> Any:
        if not isinstance(value, type) or not issubclass(value, base):
            raise ValueError(f"{name} must be a {base.__name__} class, got {value!r:.100}")
        return value

    return check


def _train_freq(name: str, value: Any) -> Any:
    if isinstance(value, TrainFreq):
        return value
    if isinstance(value, list):
        return (integer(1)(name, value[0]), value[1])
    return integer(1)(name, value)


def _arguments(name: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value) or not is_plain(value):
        raise ValueError(f"{name} must be a mapping of names to finite numbers, texts and known classes")
    if value.get("n_critics") is not None:
        integer(1, MAX_CRITICS)("n_critics", value["n_critics"])
    return value


def _none(name: str, value: Any) -> None:
    if value is not None:
        raise ValueError(f"{name} must be null, got {value!r:.100}")


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
            *("learning_starts", "_stats_window_size", "top_quantiles_to_drop_per_net"),
        ),
        integer(0),
    ),
    **dict.fromkeys(
        ("tau", "gamma", "kappa", "target_policy_noise", "target_noise_clip", "_current_progress_remaining"),
        check_number,
    ),
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


def read_fields(raw: bytes, custom_objects: dict[str, Any]) -> dict[str, Any]:
    """
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
                    value = rebuild(read_pickle(base64.b64decode(value[":serialized:"], validate=True)), classes, CALLS)
                fields[name] = _FIELDS[name](name, value)
        elif name not in _MADE_ANEW:
            raise UnsafeFileError(f"the field {name[:100]!r} is unknown (custom_objects can replace it)")
    known = constructor_hints(fields.get("policy_class", BasePolicy)).keys() - POLICY_ARGUMENTS
    fields.setdefault("policy_kwargs", {}).pop("device", None)
    for name in fields["policy_kwargs"]:
        if name not in known:
            raise UnsafeFileError(f"the field policy_kwargs has the unknown key {name[:100]!r}")
    return fields


def parse_data(raw: bytes) -> dict[str, Any]:
    with reading("data"):
        data = json.loads(raw, object_pairs_hook=_unique)
        if not isinstance(data, dict):
            raise UnsafeFileError("it does not hold fields")
        return data


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len({name for name, _ in pairs}) != len(pairs):
        raise UnsafeFileError("it has a field twice")
    return dict(pairs)


def check_replay_memory(fields: dict[str, Any]) -> None:
    size, observations = fields.get("buffer_size", 1), fields["observation_space"]
    parts: Any = observations.spaces.values() if isinstance(observations, spaces.Dict) else [observations]
    n_bytes = size * sum(2 * math.prod(part.shape) * part.dtype.itemsize for part in parts)
    if n_bytes > MAX_REPLAY_BYTES:
        raise UnsafeFileError(
            f"its replay buffer of {size:,} transitions takes {n_bytes / 2**30:,.0f} GiB: give a smaller buffer_size"
        )
