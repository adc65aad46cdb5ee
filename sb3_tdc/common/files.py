"""Helpers for files that are never half written, and for folders that no two processes share."""

import errno
import os
import re
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any


def write_atomically(write: Callable[[Path], Any], path: Path) -> None:
    """
    Write a file next to its final path, then rename it: an existing file stays whole until the new one is complete.

    The new file is on disk when this returns: a power cut does not lose it.

    :param write: function that writes the file to the path that it is given, which has the same suffix
    :param path: the final path
    """
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        write(part)
        sync(part)
        os.replace(part, path)
        sync(path.parent)
    finally:
        part.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Wait until the content of a file, or the names of the files in a folder, are on disk."""
    is_windows = os.name == "nt"
    if is_windows and path.is_dir():  # it cannot be opened
        return
    descriptor = os.open(path, os.O_RDWR if is_windows else os.O_RDONLY)  # Windows syncs only what may be written
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # a file system that cannot sync folders
            raise
    finally:
        os.close(descriptor)


def check_writable(flag: str, path: Path) -> None:
    """
    Check that a file can be written, and create its folder.

    :param flag: command-line flag that named the file, for the error
    :raises ValueError: if the file cannot be written
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        existed = path.exists()
        with path.open("ab"):
            pass
        if not existed:
            path.unlink()
    except OSError as error:
        raise ValueError(f"{flag} {path} cannot be written: {error.strerror}") from error


def check_can_be_made(flag: str, folder: Path) -> None:
    """
    Check that a folder can be written to or, if it does not exist, can be created; nothing is created.

    :param flag: command-line flag that named the folder, for the error
    :raises ValueError: if the folder, or its nearest parent that exists, cannot be written to
    """
    nearest = next(path for path in (folder, *folder.parents) if path.exists())
    if not nearest.is_dir():
        raise ValueError(f"{flag} {folder} cannot be written: {nearest} is not a folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise ValueError(f"{flag} {folder} cannot be written: {nearest} is read-only")


def make_numbered(parent: Path, name: str, suffix: str = "") -> Path:
    """Create the folder ``<name>_<next number>``; two processes that start at the same time get a folder each."""
    number = max(numbered(parent, name), default=0) + 1
    while True:
        path = parent / f"{name}_{number}{suffix}"
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            number += 1
        else:
            return path


def numbered(parent: Path, name: str) -> dict[int, Path]:
    """Return the folders ``<name>_<number>`` by number; of those with one number and different UUIDs, the newest."""
    folders = {}
    for path in sorted(parent.glob(f"{name}_*"), key=lambda p: p.stat().st_mtime):
        if path.is_dir() and (match := re.fullmatch(r"_(\d+)(_[0-9a-f-]{36})?", path.name[len(name) :])):
            folders[int(match[1])] = path
    return folders


def lock(path: Path) -> Any:
    """
    Lock a file until it is closed; create it if it does not exist.

    On Windows the file is opened, but not locked; likewise, with a warning, on a file system that has no locks.

    :return: the open file; None if another process has locked it
    """
    file = path.open("a")
    try:
        import fcntl
    except ImportError:  # Windows
        return file
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return None
    except OSError as error:
        # Without a path: a matrix locks many files, and the same sentence is shown once
        warnings.warn(
            f"The file system cannot lock files ({error.strerror}): train each run in one process at a time",
            RuntimeWarning,
            stacklevel=2,
        )
    if not is_file_at(file, path):  # removed by a process that has just finished
        file.close()
        return lock(path)
    return file


def unlock(file: Any) -> None:
    """Release the lock of a file, even if a forked process still has the file open."""
    try:
        import fcntl
    except ImportError:  # Windows
        return
    with suppress(OSError):  # a file system without locks
        fcntl.flock(file, fcntl.LOCK_UN)


def is_file_at(file: Any, path: Path) -> bool:
    """Return whether an open file is still the one at a path."""
    return path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat())
