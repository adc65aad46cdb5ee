"""MuJoCo's warnings, each printed once and not written to a file; and a check of the OpenGL that MuJoCo imports."""

import importlib
import os
import re
import sys


def check_opengl() -> None:
    """
    Check that MuJoCo can be imported: it imports the OpenGL backend named in ``MUJOCO_GL`` even if nothing is drawn.

    :raises ValueError: if MuJoCo cannot be imported with that backend
    """
    named = os.environ.get("MUJOCO_GL")
    try:
        importlib.import_module("mujoco")
    except Exception as error:
        if named and getattr(error, "name", None) != "mujoco":  # if MuJoCo is missing, its environments say so
            raise ValueError(
                f"MuJoCo cannot be imported with MUJOCO_GL={named} (from the environment): unset it, or choose "
                "another of egl, osmesa, glfw"
            ) from error


def print_warnings_once() -> None:
    """
    Print every warning of MuJoCo in this process only once, to standard error.

    By default, MuJoCo prints a warning each time, and appends it to MUJOCO_LOG.TXT in the working directory.
    """
    try:
        import mujoco
    except Exception:  # other simulators do not need it; an environment that does raises the error
        return
    if hasattr(mujoco, "set_mju_user_warning"):
        mujoco.set_mju_user_warning(_print)


def _print(text: str) -> None:
    kind = re.sub(r"\bTime = \S+", "", text)
    # Warnings of deprecation concern the model files of Gymnasium's tasks, which a user cannot change
    if kind not in _printed and "is deprecated" not in text:
        _printed.add(kind)
        print(f"MuJoCo: {text.strip()} (printed once)", file=sys.stderr, flush=True)


_printed: set[str] = set()
