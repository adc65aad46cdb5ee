"""
Open untrusted saved models: nothing in the file is imported, called or unpickled.

SB3's ``load`` runs whatever a zip asks for, and so do its replay buffers and ``VecNormalize`` files. Here every pickled
field is read as data, recognised by name and rebuilt from known classes, or refused by name; sizes are bounded before
anything is decompressed or allocated. What that covers, and what not: docs/safety.md.
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
