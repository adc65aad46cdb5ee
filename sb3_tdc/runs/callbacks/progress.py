"""The progress of a run: a bar on a terminal, occasional plain lines elsewhere."""

import os
import sys
import time
from datetime import timedelta
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback

from sb3_tdc.common.words import count

# For a run without evaluations: an evaluation prints a line itself
_SECONDS_BETWEEN_LINES = 300.0
_SECONDS_BETWEEN_BAR_UPDATES = 0.1
# A run resumed right before an evaluation has taken a single step by then: too few for a rate
_STEPS_FOR_A_RATE = 50
_DEFAULT_SIZE = {"ncols": 80, "nrows": 24}  # for a terminal that reports size 0, as in some containers


class ProgressCallback(BaseCallback):
    """
    A callback that shows steps, steps per second, time left and the last evaluation.

    :param bar: show a bar (requires tqdm) instead of lines
    :param verbose: 0 for no output
    :raises ImportError: if a bar is wanted and tqdm is missing, with the command that installs it
    """

    is_captured = False

    def __init__(self, bar: bool, verbose: int = 1):
        super().__init__(verbose)
        self.bar: Any = None
        self.tqdm: Any = _import_tqdm() if bar and verbose > 0 else None
        self.evaluation = _Evaluation(self)  # the EvalCallback's callback_after_eval
        self.last_shown = 0.0

    def _on_training_start(self) -> None:
        self.start = self.last_shown = time.monotonic()
        self.first_timestep = self.num_timesteps
        self.total_timesteps = self.locals["total_timesteps"]
        if self.tqdm is not None:
            size = {"dynamic_ncols": True} if _terminal_has_size() else _DEFAULT_SIZE
            self.bar = self.tqdm(
                total=self.total_timesteps,
                initial=self.num_timesteps,
                unit=" steps",
                unit_scale=True,
                **size,
            )

    def _on_step(self) -> bool:
        now = time.monotonic()
        if self.bar is not None:
            if now - self.last_shown > _SECONDS_BETWEEN_BAR_UPDATES:
                self.bar.update(self.num_timesteps - self.bar.n)
                self.last_shown = now
        elif now - self.last_shown > _SECONDS_BETWEEN_LINES:
            self.show_line()
        return True

    def _on_training_end(self) -> None:
        self.close()

    def close(self) -> None:
        """Close the bar and leave it on the screen; also called when training is interrupted."""
        if self.bar is not None:
            self.bar.update(self.num_timesteps - self.bar.n)
            self.bar.close()
            self.bar = None

    def say(self, text: str) -> None:
        """Print a message, above the bar if there is one."""
        if self.bar is not None:
            self.bar.write(text)
        elif self.verbose > 0:
            print(text, flush=True)

    def show_evaluation(self, evaluation: EvalCallback) -> None:
        """Show the evaluation that has just ended."""
        returns = evaluation.evaluations_results[-1]
        text = f"{np.mean(returns):.1f} ± {np.std(returns):.1f}"
        if self.bar is not None:
            self.bar.set_postfix_str(f"eval {text}, best {evaluation.best_mean_reward:.1f}")
        elif self.verbose > 0:
            self.show_line(f"eval {text} ({count(len(returns), 'episode')}), best {evaluation.best_mean_reward:.1f}")

    def show_line(self, text: str = "") -> None:
        """Print one line, for a log file."""
        if self.verbose == 0:
            return
        self.last_shown = time.monotonic()
        # Called by an evaluation, this callback has not counted the current step yet: self.num_timesteps is too small
        steps = self.model.num_timesteps
        parts = [f"{steps:>9,} steps {100 * steps / self.total_timesteps:5.1f}%"]
        done = steps - self.first_timestep
        if done >= _STEPS_FOR_A_RATE:
            rate = done / max(self.last_shown - self.start, 1e-9)
            parts += [f"{rate:.0f} steps/s", f"{timedelta(seconds=round((self.total_timesteps - steps) / rate))} left"]
        print(" | ".join([*parts, text] if text else parts), flush=True)


class _Evaluation(BaseCallback):
    """A callback for ``callback_after_eval``: shows every evaluation of its ``EvalCallback`` in the progress."""

    def __init__(self, progress: ProgressCallback):
        super().__init__()
        self.progress = progress

    def _on_step(self) -> bool:
        assert isinstance(self.parent, EvalCallback)
        self.progress.show_evaluation(self.parent)
        return True


def _terminal_has_size() -> bool:
    """Return whether standard error reports a size; True if it is not a terminal."""
    try:
        return 0 not in os.get_terminal_size(sys.stderr.fileno())
    except (OSError, ValueError, AttributeError):  # no terminal: a file, a pipe, a notebook
        return True


def _import_tqdm() -> Any:
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise ImportError('A progress bar needs tqdm: pip install "sb3-tdc[progress]"') from error
    return tqdm
