"""``sb3-tdc train`` for a process that the matrix or a search has started: it ends with its parent."""

import os
import signal
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from sb3_tdc.cli import train


def main(argv: Sequence[str]) -> int:
    """Return the exit status of ``sb3-tdc train``."""
    keep_niceness()
    threading.Thread(target=_die_with_parent, daemon=True).start()
    sys.orig_argv = ["sb3-tdc", "train", *argv]  # what to type to do the same, for the run's command.txt
    return train.main(argv)


def keep_niceness() -> None:
    """Give the niceness of this process to its session, which Linux may schedule as a group of its own (autogroup)."""
    with suppress(OSError, AttributeError):  # no such file, or no niceness: another system
        Path("/proc/self/autogroup").write_text(str(os.nice(0)))


def _die_with_parent() -> None:
    """End this process when its parent dies, however it does: the other end of the standard input closes then."""
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGKILL)
