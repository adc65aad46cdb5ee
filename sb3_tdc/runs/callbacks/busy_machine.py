"""Detection of a busy machine, on which the threads of a run wait for each other and one thread would be faster."""

import time
from collections.abc import Callable

import torch as th
from stable_baselines3.common.callbacks import BaseCallback

# Updates are judged in windows of this much training time. Three in a row outlast a pause and a short burst of load
_WINDOW_SECONDS = 10.0
_WINDOWS = 3
# Threads that wait for each other spin. Alone on the machine, they get more than 0.95 of the time of as many cores, and
# an update uses 1.0 to 1.6 times the processor time that the fastest can have used. With one or two other busy
# processes, they get 0.5 to 0.65, and an update uses 3.3 to 5 times as much. If both limits are exceeded, updates take
# at least 3 times as long as the fastest
_SHARE = 0.75
_WASTE = 2.25


class BusyMachineCallback(BaseCallback):
    """
    A callback that says once that updates are several times slower because the threads of this run wait for each other.

    An update is timed from the end of a rollout to the start of the next, so this callback must come before those that
    take time at these points. Updates are compared with the fastest. Even if the machine is busy from the start, some
    updates fit between two interruptions and are fast; not so if a single call of ``train`` makes many updates.

    :param say: prints a message
    :param remedy: advice for the end of the message
    """

    is_captured = False

    def __init__(self, say: Callable[[str], None], remedy: str):
        super().__init__()
        self.say, self.remedy = say, remedy
        self.said = False
        self.started: tuple[float, float, int] | None = None
        self.fastest = float("inf")  # seconds per update
        self.slow_windows = 0  # in a row
        self._open_window()

    def _open_window(self) -> None:
        self.updates = self.seconds = self.processor_seconds = 0.0

    def _now(self) -> tuple[float, float, int]:
        """Return wall-clock time, processor time of all threads, updates."""
        return time.perf_counter(), time.process_time(), self.model._n_updates

    def _on_rollout_end(self) -> None:
        self.started = self._now()

    def _on_rollout_start(self) -> None:
        if self.started is None or self.said:
            return
        seconds, processor_seconds, updates = (
            now - before for now, before in zip(self._now(), self.started, strict=True)
        )
        if updates == 0:
            return
        self.fastest = min(self.fastest, seconds / updates)
        self.updates += updates
        self.seconds += seconds
        self.processor_seconds += processor_seconds
        if self.seconds >= _WINDOW_SECONDS:
            self._judge_window(th.get_num_threads())
            self._open_window()

    def _judge_window(self, threads: int) -> None:
        starved = self.processor_seconds < _SHARE * threads * self.seconds
        wasteful = self.processor_seconds > _WASTE * threads * self.fastest * self.updates
        is_slow = threads > 1 and self.model.device.type == "cpu" and starved and wasteful
        self.slow_windows = self.slow_windows + 1 if is_slow else 0
        if self.slow_windows == _WINDOWS:
            self.said = True
            milliseconds = 1e3 * self.seconds / self.updates
            self.say(
                f"An update takes {milliseconds:.1f} ms, the fastest took {1e3 * self.fastest:.1f}: "
                f"other processes keep the processor busy, and the {threads} threads of this run wait for each other. "
                f"One thread is faster now: {self.remedy}"
            )

    def _on_step(self) -> bool:
        return True
