"""Checks of environments: an exception, an invalid return value or a dead process becomes an error of one sentence."""

import inspect
import signal
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial, wraps
from multiprocessing.connection import wait
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_tdc.common.exceptions import FAILURES, describe_exception

_SECONDS_TO_DIE = 5.0
_FAULT = "sb3_tdc.fault"  # in the `info` that a process sends


class EnvironmentFaultError(RuntimeError):
    """
    An environment broke gymnasium's rules, raised an exception, or lost its process.

    :param sentence: what the environment did
    :param details: the traceback, if there is one
    """

    def __init__(self, sentence: str, details: str = ""):
        super().__init__(sentence)
        self.details = details


class CheckedEnv(gym.Wrapper):
    """
    A wrapper that raises :class:`EnvironmentFaultError` for every exception and every invalid return value.

    Without it, NumPy would broadcast an observation of the wrong shape into the batch, and convert None to False.
    """

    def reset(self, **kwargs: Any) -> Any:
        result = self._call("reset", **kwargs)
        if not isinstance(result, tuple) or len(result) != 2:
            _refuse("reset() must return (observation, info)", result)
        observation, info = result
        self._check_observation("reset", observation)
        _check_info("reset", info)
        return result

    def step(self, action: Any) -> Any:
        result = self._call("step", action)
        if not isinstance(result, tuple) or len(result) != 5:
            _refuse("step() must return (observation, reward, terminated, truncated, info)", result)
        observation, reward, terminated, truncated, info = result
        self._check_observation("step", observation)
        if not _is_number(reward):
            _refuse("the reward of step() must be a number", reward)
        for name, flag in (("terminated", terminated), ("truncated", truncated)):
            if not _is_number(flag):
                _refuse(f"'{name}' of step() must be a bool", flag)
        _check_info("step", info)
        return result

    def render(self) -> Any:
        picture = self._call("render")
        if self.render_mode == "rgb_array" and _as_array(picture).ndim != 3:
            _refuse("render() must return an array (height, width, 3) in the mode rgb_array", picture)
        return picture

    def close(self) -> None:
        """Close the environment; an error becomes a warning, as training is over."""
        try:
            super().close()
        except FAILURES as error:
            warnings.warn(f"close() of the environment raised {describe_exception(error)}", stacklevel=2)

    def _call(self, name: str, *args: Any, **kwargs: Any) -> Any:
        try:
            return getattr(self.env, name)(*args, **kwargs)
        except FAILURES as error:
            sentence = f"{name}() raised {describe_exception(error)}"
            raise EnvironmentFaultError(sentence, traceback.format_exc()) from error

    def _check_observation(self, name: str, observation: Any) -> None:
        why = _why_not_in(observation, self.observation_space)
        if why:
            raise EnvironmentFaultError(f"the observation of {name}() must be {why}")


def _refuse(rule: str, value: Any) -> NoReturn:
    raise EnvironmentFaultError(f"{rule}, got {_describe(value)}")


def _describe(value: Any) -> str:
    if isinstance(value, (tuple, list)):
        return f"a {type(value).__name__} of {len(value)}"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape} and type {value.dtype}"
    return "None" if value is None else f"{type(value).__name__} {str(value)[:80]!r}"


def _check_info(name: str, info: Any) -> None:
    if not isinstance(info, dict):
        _refuse(f"'info' of {name}() must be a dict", info)


def _is_number(value: Any) -> bool:
    """Return whether a value is a bool, a number, or an array that holds one."""
    if isinstance(value, (bool, int, float)):
        return True
    array = _as_array(value)
    return array.dtype.kind in "biuf" and array.size == 1


def _as_array(value: Any) -> np.ndarray:
    try:
        return np.asarray(value)
    except (ValueError, TypeError, RuntimeError):  # a ragged list; a tensor on a GPU
        return np.array(None)


def _why_not_in(value: Any, space: gym.Space, name: str = "") -> str:
    """Return "" if a value can be stored as an observation of a space, else what it must be and what it is."""
    if isinstance(space, spaces.Dict):
        if not isinstance(value, Mapping) or set(space) - set(value):
            return f"a dict with {', '.join(map(repr, space))}, got {_describe(value)}"
        return next(filter(None, (_why_not_in(value[key], space[key], f" in {key!r}") for key in space)), "")
    if space.shape is None:
        return ""
    array = _as_array(value)
    fits = array.size == 1 if isinstance(space, spaces.Discrete) else array.shape == space.shape
    if fits and array.dtype.kind in "biuf":
        return ""
    got = _describe(array if array.dtype.kind in "biuf" else value)
    return f"numbers of shape {space.shape}{name}, got {got}"


# ---------------------------------------------------------------- processes


@dataclass(frozen=True)
class _Fault:
    """The parts of an exception that a process sends to the trainer: the exception itself may not be picklable."""

    sentence: str
    details: str

    @classmethod
    def of(cls, error: BaseException) -> "_Fault":
        if isinstance(error, EnvironmentFaultError):
            return cls(str(error), error.details)
        return cls(describe_exception(error), traceback.format_exc())


class _Reporting(gym.Wrapper):
    """A wrapper that sends faults to the trainer: SB3's worker would die of them, with a traceback on the screen."""

    fault: _Fault | None = None

    def reset(self, **kwargs: Any) -> Any:
        try:
            return super().reset(**kwargs)
        except FAILURES as error:
            return self.observation_space.sample(), {_FAULT: _Fault.of(error)}

    def step(self, action: Any) -> Any:
        try:
            return super().step(action)
        except FAILURES as error:
            return self.observation_space.sample(), 0.0, False, False, {_FAULT: _Fault.of(error)}

    def get_wrapper_attr(self, name: str) -> Any:
        """Return an attribute; a method, to be called by ``env_method``, returns its fault instead of raising it."""
        value = super().get_wrapper_attr(name)
        if not inspect.ismethod(value):
            return value

        @wraps(value)
        def report(*args: Any, **kwargs: Any) -> Any:
            try:
                return value(*args, **kwargs)
            except FAILURES as error:
                return _Fault.of(error)

        return report


class _Unmade(gym.Env):
    """A placeholder for an environment that could not be made."""

    observation_space = action_space = spaces.Box(-1, 1, (1,))

    def __init__(self, fault: _Fault):
        self.fault = fault


def _make_reporting(make_env: Callable[[], gym.Env]) -> gym.Env:
    try:
        return _Reporting(make_env())
    except FAILURES as error:
        return _Unmade(_Fault.of(error))


class CheckedSubprocVecEnv(SubprocVecEnv):
    """
    A ``SubprocVecEnv`` that raises :class:`EnvironmentFaultError` if an environment fails or its process dies.

    :raises EnvironmentFaultError: if an environment cannot be made
    """

    def __init__(self, env_fns: list[Callable[[], gym.Env]], start_method: str | None = None):
        try:
            super().__init__([partial(_make_reporting, env_fn) for env_fn in env_fns], start_method)
        except (EOFError, ConnectionError) as error:
            self._watch()
            sentence = self._find_dead().describe_death()
            self._kill()
            raise EnvironmentFaultError(sentence) from error
        self._watch()
        try:
            self.get_attr("fault")  # raises the fault of an environment that could not be made
        except EnvironmentFaultError:
            self._kill()
            raise

    def _find_dead(self) -> "_Remote":
        """Return the remote of a process that has ended, which may take a moment to show."""
        ends = {remote.process.sentinel: remote for remote in self.remotes}
        ended = wait(list(ends), _SECONDS_TO_DIE)
        return ends[ended[0]] if ended else self.remotes[0]

    def _watch(self) -> None:
        pairs = zip(self.remotes, self.processes, strict=True)
        self.remotes: Any = tuple(_Remote(i, *pair) for i, pair in enumerate(pairs))

    def step_wait(self) -> Any:
        result = super().step_wait()
        self._raise_first(result[3])
        self._raise_first(self.reset_infos)
        return result

    def reset(self) -> Any:
        observations = super().reset()
        self._raise_first(self.reset_infos)
        return observations

    def _raise_first(self, infos: Sequence[dict[str, Any]]) -> None:
        for remote, info in zip(self.remotes, infos, strict=True):
            if _FAULT in info:
                remote.fail(info[_FAULT])

    def close(self) -> None:
        """Close the environments; if a process has died, kill the others, whose answers may still be unread."""
        if not any(remote.is_dead for remote in self.remotes):
            with suppress(EnvironmentFaultError):
                return super().close()
        self._kill()

    def _kill(self) -> None:
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.join()
        self.closed = True


class _Remote:
    """
    The trainer's end of the pipe to a process of an environment.

    :param process: the process at the other end
    """

    def __init__(self, index: int, connection: Any, process: Any):
        self.index, self.connection, self.process = index, connection, process
        self.is_dead = False

    def send(self, message: Any) -> None:
        try:
            self.connection.send(message)
        except ConnectionError as error:
            raise self._death() from error

    def recv(self) -> Any:
        try:
            answer = self.connection.recv()
        except (EOFError, ConnectionError) as error:
            raise self._death() from error
        if isinstance(answer, _Fault):
            self.fail(answer)
        return answer

    def close(self) -> None:
        self.connection.close()

    def fail(self, fault: _Fault) -> NoReturn:
        raise EnvironmentFaultError(f"{fault.sentence}, in process {self.index}", fault.details)

    def _death(self) -> EnvironmentFaultError:
        self.is_dead = True
        return EnvironmentFaultError(self.describe_death())

    def describe_death(self) -> str:
        """Return a sentence on how the process ended."""
        self.process.join(_SECONDS_TO_DIE)
        code = self.process.exitcode
        if code is None:
            how = "has closed its pipe"
        elif code < 0:
            how = f"was ended by {signal.Signals(-code).name}"
        else:
            how = f"ended with exit status {code}"
        return f"the process of environment {self.index} {how}"
