"""Safe readers for the pickles saved next to a model: ``VecNormalize`` statistics and replay buffers."""

import math
import mmap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.her import HerReplayBuffer

from sb3_tdc.common.saved_fields import boolean, integer, number
from sb3_tdc.common.words import count
from sb3_tdc.safe_load.budget import Budget, UnsafeFileError
from sb3_tdc.safe_load.fields import MAX_REPLAY_BYTES
from sb3_tdc.safe_load.inert_pickle import Call, Handler, Rebuild, read_pickle
from sb3_tdc.safe_load.known_objects import CALLS, PLAIN_CALLS, pickled_name
from sb3_tdc.safe_load.reading import reading
from sb3_tdc.safe_load.regular_files import open_regular
from sb3_tdc.safe_load.sb3_fields import MAX_ENVS


def load_normalization(path: str | Path, env: VecEnv) -> VecNormalize:
    """
    Load normalisation statistics as ``VecNormalize.load`` does, without running anything that is in the file.

    :param path: statistics as SB3 and RL Zoo save them (``vecnormalize.pkl``)
    :param env: the environment to normalise
    :raises UnsafeFileError: if the file is refused or damaged, or is of an environment with other observations
    """
    with reading(f"{path} was not opened"):
        state = _read_object(path, VecNormalize, _normalization_state)
        statistics = {name: state.pop(name) for name in ("obs_rms", "ret_rms")}
        normalized = VecNormalize(env, **state)
        for name, saved in statistics.items():
            fresh = getattr(normalized, name, None)
            if not _same_layout(saved, fresh):
                raise UnsafeFileError(f"its {name} are not those of {env.observation_space}")
            if saved is not None:  # SB3 looks whether there are obs_rms
                setattr(normalized, name, saved)
        return normalized


def load_replay_buffer(path: str | Path, model: OffPolicyAlgorithm) -> None:
    """
    Load a replay buffer as ``model.load_replay_buffer`` does, without running anything that is in the file.

    :param path: a replay buffer as SB3 saves it, of the same class, size and number of environments as the model's
    :raises UnsafeFileError: if the file is refused or damaged, or is not such a replay buffer
    """
    buffer = model.replay_buffer
    assert buffer is not None
    with reading(f"{path} was not opened"):
        saved = _read_object(path, type(buffer), _arrays_like(buffer))
        if saved["n_envs"] != buffer.n_envs:
            raise UnsafeFileError(f"it is of {count(saved['n_envs'], 'environment')}, this run has {buffer.n_envs}")
        rows = np.shape(saved["rewards"])[:1]
        if rows not in ((), (buffer.buffer_size,)):
            sizes = [n * buffer.n_envs for n in (*rows, buffer.buffer_size)]
            raise UnsafeFileError(f"its buffer_size is {sizes[0]}, and that of this run is {sizes[1]}")
        for name, fresh in vars(buffer).items():
            if name in saved and not _same_layout(saved[name], fresh):
                layouts = f"{_layout(saved[name])}, not {_layout(fresh)}"
                raise UnsafeFileError(f"its {name} are not those of this run: {layouts}")
        if not 0 <= saved["pos"] < buffer.buffer_size:
            raise UnsafeFileError(f"its position, {saved['pos']}, is outside")
        if isinstance(buffer, HerReplayBuffer):
            for name in ("ep_start", "ep_length", "_current_ep_start"):
                if ((saved[name] < 0) | (saved[name] > buffer.buffer_size)).any():
                    raise UnsafeFileError(f"its {name} are outside of the buffer")
        vars(buffer).update(saved)
        if isinstance(buffer, HerReplayBuffer):
            buffer.truncate_last_trajectory()


def _read_object(path: str | Path, cls: type, read_state: Callable[[Call, Rebuild], dict[str, Any]]) -> dict[str, Any]:
    """Return the result of ``read_state`` for the pickled object in a file, which must be of class ``cls``."""
    with open_regular(path, MAX_REPLAY_BYTES) as (file, size):
        if size == 0:
            raise UnsafeFileError("it is empty")
        budget = Budget(size)
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            saved = read_pickle(content, budget)  # type: ignore[arg-type]  # a mapped file reads like a file
    if not isinstance(saved, Call) or saved.function != pickled_name(cls):
        raise UnsafeFileError(f"it does not hold a {cls.__name__}")
    return Rebuild({}, {**CALLS, pickled_name(cls): Handler(read_state, state=True)}, budget)(saved)


def _normalization_state(call: Call, make: Rebuild) -> dict[str, Any]:
    """Return the keyword arguments of ``VecNormalize``, and its statistics; nothing else in the pickle is read."""
    state = call.state
    if not isinstance(state, dict):
        raise UnsafeFileError("VecNormalize without its attributes")
    fields: dict[str, Any] = {name: make(state[name]) for name in ("obs_rms", "ret_rms") if name in state}
    for name in ("training", "norm_obs", "norm_reward"):
        fields[name] = boolean(name, make(state[name]))
    for name in ("clip_obs", "clip_reward", "gamma", "epsilon"):
        value = make(state[name])
        is_no_clipping = name.startswith("clip") and isinstance(value, float) and value == math.inf
        fields[name] = value if is_no_clipping else number(0.0)(name, value)
    keys = make(state.get("norm_obs_keys"))
    if keys is not None and not (isinstance(keys, list) and all(isinstance(key, str) for key in keys)):
        raise UnsafeFileError("norm_obs_keys that are not names")
    return {"obs_rms": None, "ret_rms": None, **fields, "norm_obs_keys": keys}


def _arrays_like(buffer: ReplayBuffer) -> Callable[[Call, Rebuild], dict[str, Any]]:
    """
    Return a function that reads only the numeric arrays, the position and the number of environments of a buffer.

    If hindsight computes rewards from the infos of transitions (``copy_info_dict``), the function reads the infos, too.
    """
    names = [name for name, value in vars(buffer).items() if isinstance(value, dict) or _is_numeric(value)]

    def read_state(call: Call, make: Rebuild) -> dict[str, Any]:
        for name in ("optimize_memory_usage", "handle_timeout_termination"):  # what a sample is made of depends on them
            saved, of_run = boolean(name, call.state[name]), getattr(buffer, name)
            if saved is not of_run:
                raise UnsafeFileError(f"it was saved with {name}={saved}, this run has {of_run}")
        position = {"pos": integer(0)("pos", make(call.state["pos"])), "full": boolean("full", call.state["full"])}
        n_envs = integer(1, MAX_ENVS)("n_envs", make(call.state["n_envs"]))
        arrays = {name: make(call.state[name]) for name in names}
        if isinstance(buffer, HerReplayBuffer) and buffer.copy_info_dict:
            arrays["infos"] = _infos(call.state, make.budget)
        return {**position, "n_envs": n_envs, **arrays}

    return read_state


def _infos(state: dict[str, Any], budget: Budget) -> np.ndarray:
    """Return the infos of a replay buffer (buffer_size, n_envs): mappings of plain values."""
    if not boolean("copy_info_dict", state["copy_info_dict"]):
        raise UnsafeFileError("it was saved without copy_info_dict, which this run has")
    with reading("its infos (copy_info_dict), which may hold numbers, texts, arrays, lists and mappings"):
        _, shape, _, is_fortran, infos = state["infos"].state
        budget.take_bytes(len(infos) * np.dtype(object).itemsize)
        if not isinstance(infos, list) or not all(type(info) is dict for info in infos):
            raise UnsafeFileError("something else than a mapping for each transition")
        make = Rebuild({}, PLAIN_CALLS, budget)
        array = np.empty(len(infos), dtype=object)
        array[:] = [make(info) if info else {} for info in infos]
        return array.reshape(shape, order="F" if is_fortran else "C")


def _is_numeric(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind in "biuf"


def _same_layout(saved: Any, fresh: Any) -> bool:
    if isinstance(fresh, dict):
        return (
            isinstance(saved, dict)
            and saved.keys() == fresh.keys()
            and all(_same_layout(saved[key], fresh[key]) for key in fresh)
        )
    if isinstance(fresh, RunningMeanStd):
        return isinstance(saved, RunningMeanStd) and np.shape(saved.mean) == np.shape(fresh.mean)
    if isinstance(fresh, np.ndarray):
        return isinstance(saved, np.ndarray) and saved.shape == fresh.shape and _same_type(saved.dtype, fresh.dtype)
    return type(saved) is type(fresh)


def _layout(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_layout(part)}" for key, part in value.items())
    return f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__


def _same_type(saved: np.dtype, fresh: np.dtype) -> bool:
    # The fused update stores observations as float32 where SB3 stores float64
    return saved == fresh or {saved, fresh} == {np.dtype(np.float32), np.dtype(np.float64)}
