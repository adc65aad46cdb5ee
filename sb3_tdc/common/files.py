"""Files that are never half written, folders that no two processes share."""

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any


def write_atomically(write: Callable[[Path], Any], path: Path) -> None:
    """
    Write a file next to its place, then rename it: a file that is already there stays whole until the new one is.

    :param write: takes the path to write to, which has the same suffix
    """
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        write(part)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def check_writable(flag: str, path: Path) -> None:
    """
    Make the folder of a file that will be written.

    :param flag: that named the file, for the error
    :raises ValueError: if it cannot be written
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
    Check that files can be made in a folder, or the folder in the nearest one that exists; nothing is made.

    :param flag: that named the folder, for the error
    :raises ValueError: if they cannot
    """
    nearest = next(path for path in (folder, *folder.parents) if path.exists())
    if not nearest.is_dir():
        raise ValueError(f"{flag} {folder} cannot be written: {nearest} is not a folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise ValueError(f"{flag} {folder} cannot be written: {nearest} is read-only")


def make_numbered(parent: Path, name: str, suffix: str = "") -> Path:
    """Make the folder ``<name>_<next number>``; two processes that start at once get one each."""
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
    """Return the folders ``<name>_<number>``, by number; of several with one number (by UUID), the newest."""
    folders = {}
    for path in sorted(parent.glob(f"{name}_*"), key=lambda p: p.stat().st_mtime):
        if path.is_dir() and (match := re.fullmatch(r"_(\d+)(_[0-9a-f-]{36})?", path.name[len(name) :])):
            folders[int(match[1])] = path
    return folders


def lock(path: Path) -> Any:
    """
    Lock a file, which is made if it does not exist, until it is closed.

    :return: the open file; None if another process has locked it
    """
    file = path.open("a")
    try:
        import fcntl
    except ImportError:  # Windows
        return file
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        return None
    if not is_file_at(file, path):  # removed by a process that has just finished
        file.close()
        return lock(path)
    return file


def unlock(file: Any) -> None:
    """Let others lock a file, also where a forked process still has it open."""
    try:
        import fcntl
    except ImportError:  # Windows
        return
    fcntl.flock(file, fcntl.LOCK_UN)


def is_file_at(file: Any, path: Path) -> bool:
    """Return whether an open file is still the one at a path."""
    return path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat())
