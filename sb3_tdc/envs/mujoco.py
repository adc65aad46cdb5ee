"""MuJoCo's warnings, each once and on the screen alone; and the OpenGL that it imports."""

import importlib
import os
import re
import sys


def check_opengl() -> None:
    """
    Import MuJoCo, which imports the OpenGL that ``MUJOCO_GL`` names, also where nothing is drawn.

    :raises ValueError: if there is none
    """
    named = os.environ.get("MUJOCO_GL")
    try:
        importlib.import_module("mujoco")
    except Exception as error:
        if named and getattr(error, "name", None) != "mujoco":  # else it is not installed, which its environments say
            raise ValueError(
                f"MuJoCo cannot be imported with MUJOCO_GL={named} (from the environment): unset it, or choose "
                "another of egl, osmesa, glfw"
            ) from error


def print_warnings_once() -> None:
    """
    Print every warning of MuJoCo in this process once, to standard error.

    By itself it prints them each time, and appends them to MUJOCO_LOG.TXT in the working directory.
    """
    try:
        import mujoco
    except Exception:  # other simulators do without; an environment that needs it says what is wrong
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
