"""``sb3-tdc train`` in a process that ``sb3-tdc matrix`` or ``sb3-tdc tune`` has started; it ends with its parent."""

import os
import signal
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from sb3_tdc.cli import train


def main(argv: Sequence[str]) -> int:
    """Run ``sb3-tdc train``, and return its exit status."""
    keep_niceness()
    threading.Thread(target=_die_with_parent, daemon=True).start()
    sys.orig_argv = ["sb3-tdc", "train", *argv]  # an equivalent command to type, for command.txt
    return train.main(argv)


def keep_niceness() -> None:
    """Apply the niceness of this process to its session, which Linux may schedule as one group (autogroup)."""
    with suppress(OSError, AttributeError):  # no such file, or no niceness: another system
        Path("/proc/self/autogroup").write_text(str(os.nice(0)))


def _die_with_parent() -> None:
    """End this process when its parent dies for any reason, which closes the other end of standard input."""
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGKILL)
