"""Stopping by Ctrl-C or ``kill``: training ends after the current step, with everything consistent."""

import inspect
import signal
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdc.common.output import write_from_handler
from sb3_tdc.envs.processes import STOP_SIGNALS
from sb3_tdc.resume import ResumeCallback

# How long to wait for the end of the rollout, where a resume state can be written
_PATIENCE_SECONDS = 5.0
# A user takes longer to press Ctrl-C twice; a program that signals both a process and its group (timeout) does not
_ONE_SIGNAL_SECONDS = 0.2


class StopOnSignalCallback(BaseCallback):
    """
    A context that handles SIGINT, SIGTERM and SIGHUP, and a callback that ends training after one of them.

    A second Ctrl-C raises ``KeyboardInterrupt``. SIGTERM and SIGHUP may arrive several times, for the process and for
    its group, and never raise, so that the resume state is not lost: an exception raised by a handler at an arbitrary
    point could leave a step of environment processes half received or a file half written.

    :param states: write a resume state first, if the next rollout starts within a few seconds
    """

    is_captured = False

    def __init__(self, states: ResumeCallback | None = None) -> None:
        super().__init__()
        self.requested, self.requested_at = False, 0.0
        self.states = states
        self.deadline = 0.0
        if states is not None:
            states.is_wanted = lambda: self.requested

    def __enter__(self) -> "StopOnSignalCallback":
        if threading.current_thread() is threading.main_thread():  # Python allows handlers only there
            taken = [number for number in STOP_SIGNALS if not _is_ignored_hangup(number)]
            self.previous = {number: signal.signal(number, self._handle) for number in taken}
        else:
            self.previous = {}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self.previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if self.requested:
            if number == signal.SIGINT and now > self.requested_at + _ONE_SIGNAL_SECONDS:
                raise KeyboardInterrupt
            return
        self.requested, self.requested_at = True, now
        self.deadline = now + _PATIENCE_SECONDS
        write_from_handler("\nStopping after this step; Ctrl-C once more to stop without saving.\n")

    def _on_rollout_start(self) -> None:
        if self.requested and self.states is not None and self.states.last_try == self.model.num_timesteps:
            self.deadline = 0.0  # the state is written, or could not be

    def _on_step(self) -> bool:
        return not self.requested or (self.states is not None and time.monotonic() < self.deadline)


def _is_ignored_hangup(number: signal.Signals) -> bool:
    """Return whether a signal is SIGHUP and ignored, as in a process started with ``nohup``."""
    return number.name == "SIGHUP" and signal.getsignal(number) == signal.SIG_IGN


class StoppableEvaluation(EvalCallback):
    """An ``EvalCallback`` that a signal ends between two steps, so that even an endless episode can be stopped."""

    def __init__(self, eval_env: VecEnv, stop: StopOnSignalCallback, **kwargs: Any):
        super().__init__(eval_env, **kwargs)
        self.stop = stop

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        if self.stop.requested:
            raise _EvaluationStoppedError
        super()._log_success_callback(locals_, globals_)

    def _on_step(self) -> bool:
        try:
            return super()._on_step()
        except _EvaluationStoppedError:
            return False
        except OSError as error:
            if _is_raised_in(error, evaluate_policy):  # raised by the environment, not by writing the results
                raise
            warnings.warn(f"The evaluation of step {self.num_timesteps:,} was not written: {error}", stacklevel=2)
            return True


def _is_raised_in(error: Exception, function: Callable) -> bool:
    """Return whether an exception was raised within a call of a function."""
    code = inspect.unwrap(function).__code__
    return any(frame.f_code is code for frame, _ in traceback.walk_tb(error.__traceback__))


class _EvaluationStoppedError(Exception):
    """Ends an evaluation after a signal; never leaves this module."""
