"""
Loaders for untrusted saved models: nothing in the file is imported, called or unpickled.

SB3's ``load`` runs any code that a zip names, and so do its loaders of replay buffers and ``VecNormalize`` statistics.
Here every pickled field is read as data. A field is rebuilt from known classes, or refused with an error that names it.
Sizes are bounded before anything is decompressed or allocated. docs/safety.md says what this covers, and what it does
not.
"""

from sb3_tdc.safe_load.budget import UnsafeFileError
from sb3_tdc.safe_load.models import load_safely, read_data, read_system_info
from sb3_tdc.safe_load.objects import load_normalization, load_replay_buffer

__all__ = [
    "UnsafeFileError",
    "load_normalization",
    "load_replay_buffer",
    "load_safely",
    "read_data",
    "read_system_info",
]
