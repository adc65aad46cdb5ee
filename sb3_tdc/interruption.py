"""Ctrl-C and a polite kill: training ends after the step under way, with everything consistent."""

import signal
import sys
import threading
import time
import warnings
from types import FrameType, TracebackType
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdc.checkpoint import Checkpoints

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
# How long a rollout may take to its end, where a checkpoint can be written
_PATIENCE_SECONDS = 5.0


class StopOnSignal(BaseCallback):
    """
    As a context, it takes SIGINT and SIGTERM; as a callback, it ends training after one. A second one interrupts.

    An exception raised by a handler, anywhere, could leave a step of processes half received or a file half written.

    :param checkpoints: write one first, when the next rollout starts, if that is soon
    """

    is_checkpointed = False

    def __init__(self, checkpoints: Checkpoints | None = None) -> None:
        super().__init__()
        self.requested = False
        self.checkpoints = checkpoints
        self.deadline = 0.0
        if checkpoints is not None:
            checkpoints.is_wanted = lambda: self.requested

    def __enter__(self) -> "StopOnSignal":
        if threading.current_thread() is threading.main_thread():  # Python allows handlers there alone
            self.previous = {number: signal.signal(number, self._handle) for number in _SIGNALS}
        else:
            self.previous = {}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self.previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        self.deadline = time.monotonic() + _PATIENCE_SECONDS
        print("\nStopping after this step; once more to stop without saving.", file=sys.stderr, flush=True)

    def _on_rollout_start(self) -> None:
        if self.requested and self.checkpoints is not None and self.checkpoints.last_step == self.model.num_timesteps:
            self.deadline = 0.0  # it is written

    def _on_step(self) -> bool:
        return not self.requested or (self.checkpoints is not None and time.monotonic() < self.deadline)


class StoppableEvaluation(EvalCallback):
    """An ``EvalCallback`` that a signal ends between two steps, also where an episode would never end."""

    def __init__(self, eval_env: VecEnv, stop: StopOnSignal, **kwargs: Any):
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
        except OSError as error:  # a full disk
            warnings.warn(f"The evaluation of step {self.num_timesteps:,} was not written: {error}", stacklevel=2)
            return True


class _EvaluationStoppedError(Exception):
    """Never leaves this module."""


def ignore_interrupts() -> None:
    """For processes of environments: a Ctrl-C in the terminal reaches them too, but the trainer ends them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
