"""
Hyperparameter files (YAML), read into validated keyword arguments of an algorithm.

The keys are RL Zoo's. No value is evaluated as code. This module knows neither the command line nor environments.
"""

import collections.abc
import importlib
import inspect
import math
import re
import types
import typing
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch as th
from gymnasium.wrappers import NormalizeObservation
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tdc.common import plain_yaml
from sb3_tdc.common.checks import OFF_POLICY_LIMITS, Limits, check_within, suggest, unknown
from sb3_tdc.common.exceptions import FAILURES, describe_exception
from sb3_tdc.common.signatures import constructor_parameters

# Keys that an entry may have in addition to the keyword arguments of the algorithm, with their types
_RUN_KEYS: dict[str, Any] = {
    "n_timesteps": int,
    "n_envs": int,
    "normalize": bool | dict,
    "frame_stack": int | None,
    "env_wrapper": str | dict | list | None,
    "vec_env_wrapper": str | dict | list | None,
    "callback": str | dict | list | None,
    "env_kwargs": dict[str, Any],
    "monitor_kwargs": dict[str, Any],
    "noise_type": str | None,
    "noise_std": float | list[float],
}
_RUN_LIMITS: Limits = {
    **dict.fromkeys(("n_timesteps", "n_envs", "frame_stack"), (1, math.inf)),
    "noise_std": (0.0, math.inf),
}
# Keyword arguments that belong to one run, not to an environment, and the flags of train.py that set them
_FLAGS = {name: f"--{name.replace('_', '-')}" for name in ("env", "seed", "device", "verbose", "tensorboard_log")}
OF_ONE_RUN = {*_FLAGS, "self", "_init_setup_model"}
# Arguments of the algorithm that decide what its network is
OF_THE_NETWORK = ("policy", "policy_kwargs", "stochastic_actor", "use_sde")
# Arguments that the algorithm itself passes to the policy
POLICY_ARGUMENTS = {"self", "observation_space", "action_space", "lr_schedule"}
# Modules whose classes may be named without the module
_CLASS_MODULES = ("torch.nn", "torch.optim", "stable_baselines3", "stable_baselines3.common.buffers")
# Mappings of keyword arguments: the class that takes them, and its arguments that the user cannot set
_OPTIONS: dict[str, tuple[type, tuple[str, ...]]] = {
    "normalize": (VecNormalize, ("venv",)),
    "monitor_kwargs": (Monitor, ("env", "filename")),
}
_NOISE_TYPES = ("normal", "ornstein-uhlenbeck")
_OF_NOISE = ("noise_type", "noise_std")
# Wrappers whose statistics the policy depends on, but which are not saved with it
_NORMALIZING = (VecNormalize, NormalizeObservation)


@dataclass
class Hyperparams:
    """
    One validated entry of a hyperparameter file.

    :param raw: the entry as written, for ``config.yml``
    :param model: keyword arguments of the algorithm's constructor
    :param n_timesteps: environment steps to train for
    :param normalize: keyword arguments of ``VecNormalize``, or None for none
    :param env_wrapper: callables that take and return an environment
    :param vec_env_wrapper: the same for a vectorised environment
    :param callbacks: factories of callbacks
    :param noise_std: standard deviation of the action noise of ``noise_type``, in normalised action units; a
        list of two values gives that of the first environment and that of the last
    """

    raw: dict[str, Any]
    model: dict[str, Any]
    n_timesteps: int
    n_envs: int = 1
    normalize: dict[str, Any] | None = None
    frame_stack: int | None = None
    env_wrapper: list[Callable] = field(default_factory=list)
    vec_env_wrapper: list[Callable] = field(default_factory=list)
    callbacks: list[Callable] = field(default_factory=list)
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    monitor_kwargs: dict[str, Any] = field(default_factory=dict)
    noise_type: str | None = None
    noise_std: float | list[float] = 0.0

    @property
    def schedules(self) -> list[str]:
        """Return the names of the hyperparameters that are schedules of the remaining share of ``n_timesteps``."""
        return [name for name, value in self.model.items() if isinstance(value, LinearSchedule)]


def hyperparams_file(algo: str) -> Path:
    """Return this package's file of an algorithm; a variant (``tdc-shift``) uses the file of its algorithm."""
    package = Path(__file__).parent
    installed, checkout = package / "_hyperparams", package.parent / "hyperparams"
    return (installed if installed.is_dir() else checkout) / f"{algo.partition('-')[0]}.yml"


def read_entry(path: Path, env_id: str, preset: str | None = None) -> tuple[dict[str, Any], str]:
    """
    Return the entry of an environment, or else of its nearest version, completed by the file's ``default``.

    :param preset: the name of an entry to use instead
    :return: the entry and its name in the file: ``default`` if no version of the environment has an entry
    :raises ValueError: if the file cannot be read, or has neither an entry nor a default
    """
    try:
        entries = plain_yaml.load(path.read_text(), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: {getattr(error, 'strerror', None) or 'is not a text'}") from error
    if not isinstance(entries, dict) or not all(isinstance(e, dict) for e in entries.values()):
        raise ValueError(f"{path} must map environment ids to hyperparameters")
    if preset is not None and preset not in entries:
        raise ValueError(f"{path}: {unknown('entry', preset, map(str, entries))}")
    name = preset or _nearest_version(env_id, entries)
    if name not in entries:
        raise ValueError(f"{path} has no entry for {env_id} and no default{suggest(env_id, entries)}")
    return {**entries.get("default", {}), **entries[name]}, name


def _nearest_version(env_id: str, names: Iterable[Any]) -> str:
    """Return the name of an id's nearest version (of two equally near, the newer), or ``default`` if there is none."""
    names = [str(name) for name in names]
    if env_id in names:
        return env_id
    base, version = _split_version(env_id)
    versions = {_split_version(name)[1]: name for name in names if _split_version(name)[0] == base}
    # An id without a version stands for the newest one
    key = (lambda other: other) if version < 0 else (lambda other: (-abs(other - version), other))
    return versions[max(versions, key=key)] if versions else "default"


def _split_version(env_id: str) -> tuple[str, int]:
    """Return ``("Walker2d", 4)`` for ``Walker2d-v4``; without a version, −1."""
    base, _, version = env_id.rpartition("-v")
    return (base, int(version)) if base and version.isdecimal() else (env_id, -1)


def merge(entry: dict[str, Any], overrides: dict[str, Any]) -> dict[str, Any]:
    """
    Return an entry with values replaced.

    :param overrides: the values. If they set the noise, by ``action_noise`` or by ``noise_type`` and ``noise_std``, the
        entry's noise by the other keys is dropped
    """
    dropped: tuple[str, ...] = ()
    if "action_noise" in overrides:
        dropped = _OF_NOISE
    elif any(key in overrides for key in _OF_NOISE):
        dropped = ("action_noise",)
    return {**{key: value for key, value in entry.items() if key not in dropped}, **overrides}


def parse(
    entry: dict[str, Any],
    algorithm: type[BaseAlgorithm],
    where: str,
    overrides: dict[str, Any] | None = None,
    where_overrides: str = "",
) -> Hyperparams:
    """
    Check every key and value of an entry against the algorithm's constructor.

    :param entry: as read from the file
    :param algorithm: its constructor's annotations are the schema
    :param where: the file and the environment, for the error
    :param overrides: values that replace those of the entry; conditions on several keys are checked after the merge
    :param where_overrides: where the overrides were given, for the error
    :raises ValueError: naming the key, its value, the allowed values, and the nearest known key
    """
    overrides = overrides or {}
    raw = merge(entry, overrides)
    hints = {key: hint for key, hint in constructor_hints(algorithm).items() if key not in OF_ONE_RUN}
    hints.update(_RUN_KEYS)
    kept = {key: value for key, value in raw.items() if key not in overrides}
    for mapping, place_of in ((kept, where), (overrides, where_overrides)):
        for key in (key for key in mapping if key in _FLAGS):
            raise ValueError(f"{place_of}: {key} is not a hyperparameter; use {_FLAGS[key]}")
    limits = {**getattr(algorithm, "limits", OFF_POLICY_LIMITS), **_RUN_LIMITS}
    values = {
        **convert_mapping(kept, hints, where, limits),
        **convert_mapping(overrides, hints, where_overrides, limits),
    }

    def place(*keys: str) -> str:
        return where_overrides if any(key in overrides for key in keys) else where

    if "n_timesteps" not in values:
        raise ValueError(f"{where}: n_timesteps is missing")
    _check_noise(values, place("action_noise", *_OF_NOISE))
    _convert_policy(values, algorithm, place("policy"), place("policy_kwargs"), limits)
    for key, (cls, others) in _OPTIONS.items():
        if isinstance(values.get(key), dict):
            hints = {name: hint for name, hint in constructor_hints(cls).items() if name not in ("self", *others)}
            values[key] = convert_mapping(values[key], hints, f"{place(key)}: {key}")

    run = {key: values.pop(key) for key in _RUN_KEYS if key in values}
    normalize = run.pop("normalize", False)
    if normalize is not False:
        options = normalize if isinstance(normalize, dict) else {}
        normalize = {"gamma": values.get("gamma", 0.99), **options}
    for key in ("env_wrapper", "vec_env_wrapper"):
        run[key] = _factories(run.get(key), f"{place(key)}: {key}")
    return Hyperparams(
        raw=raw,
        model=values,
        normalize=normalize or None,
        callbacks=_factories(run.pop("callback", None), f"{place('callback')}: callback"),
        **run,
    )


def constructor_hints(cls: type) -> dict[str, Any]:
    """Return the annotation of every argument of a constructor, including those it passes on by ``**kwargs``."""
    hints = {name: parameter.annotation for name, parameter in constructor_parameters(cls).items()}
    # A missing annotation, or one that is a string, allows any value
    return {
        name: Any if hint is inspect.Parameter.empty or isinstance(hint, str) else hint for name, hint in hints.items()
    }


def convert_mapping(
    mapping: dict[str, Any], hints: dict[str, Any], where: str, limits: Limits | None = None
) -> dict[str, Any]:
    """
    Convert every value of a mapping to the type of its annotation.

    :param hints: the annotation of every known key
    :param where: where the mapping was given, for the error
    :param limits: limits by key, which hold for a number and for every number within a value
    :raises ValueError: naming the key, its value and the allowed values
    """
    converted = {}
    for key, value in mapping.items():
        if key not in hints:
            raise ValueError(
                f"{where}: unknown key {key!r}{suggest(str(key), hints) or '; known: ' + ', '.join(hints)}"
            )
        try:
            converted[key] = _convert(value, hints[key])
        except (TypeError, ValueError, OverflowError) as error:
            detail = f" ({error})" if str(error) else ""
            raise ValueError(f"{where}: {key} must be {_describe(hints[key])}, got {value!r}{detail}") from error
        if limits and key in limits:
            for number in _numbers_in(converted[key]):
                check_within(limits, key, number, f"{where}: {key}")
    return converted


def _numbers_in(value: Any) -> Iterator[float]:
    """Yield the numbers in a value: the number itself, the first of a schedule, or those in a list or a mapping."""
    if isinstance(value, LinearSchedule):
        yield value(1.0)
    elif isinstance(value, (list, tuple, dict)):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _numbers_in(part)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield value


def _check_noise(values: dict[str, Any], where: str) -> None:
    noise_type, sigmas = values.get("noise_type"), values.get("noise_std")
    if values.get("action_noise") is not None and noise_type is not None:
        raise ValueError(f"{where}: the noise must be either action_noise, or noise_type and noise_std, got both")
    if noise_type not in (None, *_NOISE_TYPES):
        raise ValueError(f"{where}: noise_type must be one of {', '.join(_NOISE_TYPES)}, got {noise_type!r}")
    if noise_type is not None and sigmas is None:
        raise ValueError(f"{where}: noise_type {noise_type} requires noise_std")
    if sigmas and "noise_type" not in values:
        raise ValueError(f"{where}: noise_std requires noise_type, one of {', '.join(_NOISE_TYPES)}")
    if isinstance(sigmas, list) and (len(sigmas) != 2 or noise_type != "normal"):
        raise ValueError(f"{where}: noise_std must be a number, or two with noise_type normal, got {sigmas}")


def _convert_policy(
    values: dict[str, Any], algorithm: type[BaseAlgorithm], where: str, where_kwargs: str, limits: Limits
) -> None:
    """Resolve the policy, and check ``policy_kwargs`` against its constructor."""
    policy = values.setdefault("policy", "MlpPolicy")
    if isinstance(policy, str) and "." in policy:
        try:
            policy = values["policy"] = _import_class(policy, BasePolicy)
        except ValueError as error:
            raise ValueError(f"{where}: policy: {error}") from error
    if isinstance(policy, str):
        if policy not in algorithm.policy_aliases:
            raise ValueError(f"{where}: {unknown('policy', policy, algorithm.policy_aliases)}, or module.Class")
        policy = algorithm.policy_aliases[policy]
    if values.get("policy_kwargs"):
        hints = {key: hint for key, hint in constructor_hints(policy).items() if key not in POLICY_ARGUMENTS}
        where_kwargs = f"{where_kwargs}: policy_kwargs"
        values["policy_kwargs"] = convert_mapping(values["policy_kwargs"], hints, where_kwargs, limits)


def _convert(value: Any, hint: Any) -> Any:
    """
    Convert a value to the type of an annotation.

    :raises TypeError, ValueError: if that is not possible
    """
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return value
    if origin in (typing.Union, types.UnionType):
        return _convert_union(value, args)
    if hint is float:
        return float(_number(value))
    if hint is int:
        number = _number(value)
        if number != int(number):
            raise TypeError
        return int(number)
    if origin is collections.abc.Callable:
        return _schedule(value)
    if origin is type or hint is type:
        return _import_class(value, args[0] if args else object)
    if origin is tuple and isinstance(value, list) and args[-1] is Ellipsis:
        return tuple(_convert(item, args[0]) for item in value)
    if origin is tuple and isinstance(value, list) and len(value) == len(args):
        return tuple(_convert(v, a) for v, a in zip(value, args, strict=True))
    if origin is list and isinstance(value, list):
        return [_convert(v, args[0]) for v in value]
    if dict in (origin, hint) and isinstance(value, str):
        value = plain_yaml.read_notation(value)
    if origin is dict and isinstance(value, dict):
        return {k: _convert(v, args[1]) for k, v in value.items()}
    if hint is Path and isinstance(value, str):
        return Path(value)
    if hint is type(None) and value is None:
        return None
    if isinstance(hint, type) and hint is not bool and isinstance(value, hint):
        return value
    if hint is bool and isinstance(value, bool):
        return value
    raise TypeError


def _convert_union(value: Any, members: tuple[Any, ...]) -> Any:
    reasons = []
    for member in members:
        try:
            return _convert(value, member)
        except (TypeError, ValueError, OverflowError) as error:
            reasons += [str(error)] if str(error) else []
    raise TypeError("; ".join(reasons))


def _number(value: Any) -> float:
    """Return a number. It may be a string, since YAML reads 3e-4 and 1e6 as strings."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise TypeError
    try:
        return value if not isinstance(value, str) else float(value)
    except ValueError:
        raise TypeError from None


def _schedule(value: Any) -> Callable[[float], float]:
    if not isinstance(value, str) or not value.startswith("lin_"):
        raise TypeError
    return LinearSchedule(_number(value.removeprefix("lin_")), 0.0, 1.0)


def _import_class(name: Any, base: Any = object) -> type:
    if not isinstance(name, str):
        raise TypeError
    modules, _, attribute = name.rpartition(".")
    modules = re.sub(r"^(?:th\b|(?=nn\b))", lambda match: "torch" if match[0] else "torch.", modules)
    for module in [modules] if modules else _CLASS_MODULES:
        try:
            found = getattr(importlib.import_module(module), attribute, None)
        except ModuleNotFoundError as error:
            raise ValueError(f"there is no module {error.name!r}") from error
        except FAILURES as error:
            raise ValueError(describe_exception(error)) from error
        if isinstance(found, type) and (not isinstance(base, type) or issubclass(found, base)):
            return found
    raise ValueError(f"{name!r} names no {getattr(base, '__name__', base)} class")


def _factories(entries: Any, where: str) -> list[Callable]:
    """Convert ``module.Class``, ``{module.Class: {keyword: value}}``, or a list of these, to factories."""
    factories = []
    for entry in [] if entries is None else entries if isinstance(entries, list) else [entries]:
        name, kwargs = next(iter(entry.items())) if isinstance(entry, dict) and len(entry) == 1 else (entry, {})
        try:
            if not isinstance(kwargs, dict | None):
                raise TypeError
            cls = _import_class(name)
        except (TypeError, ValueError) as error:
            detail = f": {error}" if str(error) else ""
            raise ValueError(f"{where} must name a class, or map it to its keyword arguments{detail}") from error
        if issubclass(cls, _NORMALIZING):
            raise ValueError(f"{where}: the statistics of {cls.__name__} are not saved with a model; use normalize")
        factories.append(lambda *args, cls=cls, kwargs=kwargs or {}: cls(*args, **kwargs))
    return factories


def _describe(hint: Any) -> str:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(_describe(member) for member in args))
    if origin is collections.abc.Callable:
        return 'a schedule ("lin_" and a number)'
    if origin is type:
        return f"the name of a {args[0].__name__} class"
    if origin in (tuple, list):
        return f"a list of {', '.join(_describe(a) for a in args if a is not Ellipsis)}"
    simple = {
        float: "a number",
        int: "an integer",
        bool: "true or false",
        str: "a text",
        Path: "a path",
        type(None): "null",
    }
    simple.update({dict: "a mapping", list: "a list", th.device: "a device"})
    if origin is dict or hint in simple:
        return simple[origin or hint]
    return f"a {getattr(hint, '__name__', hint)}"
