"""Whether there are compiled loops."""

from functools import cache
from types import ModuleType


@cache
def load_kernels() -> ModuleType | None:
    """Return the module of compiled loops, or None without Numba (the extra ``[fast]``) or with its JIT disabled."""
    try:
        import numba
    except ImportError:  # also where an installed Numba does not support the installed NumPy
        return None
    if numba.config.DISABLE_JIT:
        return None
    from sb3_tdc.tdc import kernels

    return kernels


def numba_version() -> str | None:
    """Return the version of Numba that compiles the loops, or None where there are none."""
    kernels = load_kernels()
    return kernels.numba.__version__ if kernels is not None else None
