"""TDC-λ and the paper's rivals for Stable-Baselines3: ``from sb3_tdc import TDC``."""

from importlib.metadata import version

from sb3_tdc.advb import AdvBSAC, AdvBTD3, AdvBTDC
from sb3_tdc.common.diagnostics import NonFiniteError
from sb3_tdc.meow import MEOW
from sb3_tdc.resume import ResumeStates
from sb3_tdc.safe_load import UnsafeFileError, load_safely
from sb3_tdc.tdc import TDC

__version__ = version("sb3-tdc")
__all__ = [
    "MEOW",
    "TDC",
    "AdvBSAC",
    "AdvBTD3",
    "AdvBTDC",
    "NonFiniteError",
    "ResumeStates",
    "UnsafeFileError",
    "__version__",
    "load_safely",
]
