"""TDC-λ and the paper's baselines for Stable-Baselines3: ``from sb3_tdc import TDC``."""

import importlib
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_tdc.advb import AdvBSAC, AdvBTD3, AdvBTDC
    from sb3_tdc.common.finite import NonFiniteError
    from sb3_tdc.meow import MEOW
    from sb3_tdc.resume import ResumeCallback
    from sb3_tdc.safe_load import UnsafeFileError, load_safely
    from sb3_tdc.tdc import TDC

# Imported on first access: importing PyTorch takes seconds, during which `sb3-tdc` would ignore --help and Ctrl-C
_MODULES = {
    "MEOW": "meow",
    "TDC": "tdc",
    "AdvBSAC": "advb",
    "AdvBTD3": "advb",
    "AdvBTDC": "advb",
    "NonFiniteError": "common.finite",
    "ResumeCallback": "resume",
    "UnsafeFileError": "safe_load",
    "load_safely": "safe_load",
}

__version__ = version("sb3-tdc")
__all__ = [
    "MEOW",
    "TDC",
    "AdvBSAC",
    "AdvBTD3",
    "AdvBTDC",
    "NonFiniteError",
    "ResumeCallback",
    "UnsafeFileError",
    "__version__",
    "load_safely",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
