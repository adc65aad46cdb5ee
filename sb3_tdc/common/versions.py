"""The versions, commit and processor that a result depends on in addition to its seed."""

import platform
import re
import subprocess
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import gymnasium as gym
import numpy as np
import stable_baselines3
import torch as th


@cache
def numba_version() -> str | None:
    """Return the version of Numba (the extra ``[fast]``), or None without it or with its JIT disabled."""
    try:
        import numba
    except ImportError:  # also where an installed Numba does not support the installed NumPy
        return None
    return None if numba.config.DISABLE_JIT else numba.__version__


def library_versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries that compute; PyBullet's only if it is installed."""
    pybullet = _installed("pybullet")
    return {
        "python": platform.python_version(),
        "torch": str(th.__version__),  # a plain string, not PyTorch's subclass of it
        "numpy": np.__version__,
        "stable_baselines3": stable_baselines3.__version__,
        "gymnasium": gym.__version__,
        "mujoco": _installed("mujoco"),
        "numba": numba_version() or "absent",
        **({"pybullet": pybullet} if pybullet != "absent" else {}),
    }


def _installed(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"


def processor_name() -> str:
    """Return the model name of the processor, or what Python reports where Linux's ``/proc/cpuinfo`` has none."""
    cpuinfo = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*: (.*)", cpuinfo.read_text()) if cpuinfo.is_file() else None
    return found[1] if found else platform.processor()


def commit_of_the_code() -> str:
    """Return the commit of the clone that contains this package, and whether files differ from it; "" for a wheel."""
    root = Path(__file__).resolve().parents[2]
    try:
        commit = _git(root, "rev-parse", "HEAD")
        return f"{commit}, with uncommitted changes" if _git(root, "status", "--porcelain", "-uno") else commit
    except (OSError, subprocess.CalledProcessError):
        return ""


def _git(root: Path, *arguments: str) -> str:
    if not (root / ".git").exists():  # an installed package, perhaps inside another repository
        raise FileNotFoundError(root / ".git")
    return subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=True).stdout.strip()
