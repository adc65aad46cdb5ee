"""Access to the compiled loops, where Numba is available."""

from functools import cache
from types import ModuleType

from sb3_tdc.common.versions import numba_version


@cache
def load_kernels() -> ModuleType | None:
    """Return the module of compiled loops, or None where Numba cannot compile them."""
    if numba_version() is None:
        return None
    from sb3_tdc.tdc import kernels

    return kernels
