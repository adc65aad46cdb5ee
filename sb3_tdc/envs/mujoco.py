"""MuJoCo's warnings: each once, on the screen alone."""

import re
import sys


def print_warnings_once() -> None:
    """
    Print every warning of MuJoCo in this process once, to standard error.

    By itself it prints them each time, and appends them to MUJOCO_LOG.TXT in the working directory.
    """
    try:
        import mujoco
    except ImportError:  # other simulators do without
        return
    if hasattr(mujoco, "set_mju_user_warning"):
        mujoco.set_mju_user_warning(_print)


def _print(text: str) -> None:
    kind = re.sub(r"\bTime = \S+", "", text)
    # What is deprecated is in the files of gymnasium's tasks: nothing that a user could change
    if kind not in _printed and "is deprecated" not in text:
        _printed.add(kind)
        print(f"MuJoCo: {text.strip()} (printed once)", file=sys.stderr, flush=True)


_printed: set[str] = set()
