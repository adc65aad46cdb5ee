"""Exact, crash-safe checkpoints of SB3's off-policy algorithms (docs/resume.md)."""

from sb3_tdc.checkpoint.callback import DEFAULT_FREQ, Checkpoints
from sb3_tdc.checkpoint.codec import NotCapturedError, NotRestoredError
from sb3_tdc.checkpoint.simulators import Restorable
from sb3_tdc.checkpoint.store import BrokenCheckpointError, LockedError, stored_steps

__all__ = [
    "DEFAULT_FREQ",
    "BrokenCheckpointError",
    "Checkpoints",
    "LockedError",
    "NotCapturedError",
    "NotRestoredError",
    "Restorable",
    "stored_steps",
]
