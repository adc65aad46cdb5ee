"""TDC-λ and MEOW for Stable-Baselines3: ``from sb3_tdc import TDC, MEOW``."""

from importlib.metadata import version

from sb3_tdc.meow import MEOW
from sb3_tdc.safe_load import UnsafeFileError, load_safely
from sb3_tdc.tdc import TDC, NonFiniteError

__version__ = version("sb3-tdc")
__all__ = ["MEOW", "TDC", "NonFiniteError", "UnsafeFileError", "__version__", "load_safely"]
