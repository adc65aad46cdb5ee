"""Exact, crash-safe continuation of runs of SB3's off-policy algorithms (docs/resume.md)."""

from sb3_tdc.resume.callback import DEFAULT_FREQ, ResumeCallback
from sb3_tdc.resume.restorable import Restorable
from sb3_tdc.resume.store import BrokenStateError, LockedError, stored_steps
from sb3_tdc.resume.walk import NotCapturedError, NotRestoredError

__all__ = [
    "DEFAULT_FREQ",
    "BrokenStateError",
    "LockedError",
    "NotCapturedError",
    "NotRestoredError",
    "Restorable",
    "ResumeCallback",
    "stored_steps",
]
