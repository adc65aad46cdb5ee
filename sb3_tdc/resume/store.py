"""
Storage of states in folders that exist completely or not at all.

``<folder>/step_000000010000/`` holds the files of one state. Its ``manifest``, written last, holds the SHA-256 of these
files, and of the shared files in ``<folder>/replay/`` that the state needs. Every state and every shared file is
written under another name next to its final place, synced, and renamed.
"""

import hashlib
import json
import os
import re
import shutil
import warnings
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

from sb3_tdc.common.files import is_file_at, lock, sync, unlock, write_atomically

Writer = Callable[[Path], Any]

_FORMAT = 1
_MANIFEST = "manifest"
_SHARED = "replay"
_STEP = re.compile(r"step_(\d{12,})")


class BrokenStateError(ValueError):
    """A state that is damaged or incomplete; the message names the file."""


class LockedError(ValueError):
    """The folder is locked by another process, or by a newer store of this process."""


@dataclass(frozen=True)
class Stored:
    """
    One state on disk, verified.

    :param step: timestep of the state
    :param path: folder of the state
    :param shared: SHA-256 of the shared files that the state needs, by name
    """

    step: int
    path: Path
    shared: dict[str, str]

    def shared_file(self, name: str) -> Path:
        """Return the path of a shared file."""
        return self.path.parent / _SHARED / name


def stored_steps(folder: Path) -> list[int]:
    """Return the timesteps of all states in a folder, intact or not, newest first."""
    found = [_STEP.fullmatch(path.name) for path in folder.glob("step_*")]
    return sorted((int(match[1]) for match in found if match), reverse=True)


# The open stores of this process, by folder
_OPEN: "WeakValueDictionary[Path, Store]" = WeakValueDictionary()


class Store:
    """
    The states of one run on disk.

    Within a process, only the newest store of a folder can write to it; an older store finds the folder locked.

    :param folder: folder of the states; created if it is missing
    :param keep: number of the newest states to keep
    :param span: also keep one state that is at least this many steps older than the newest, and, once the run is long
        enough, less than twice as many; 0 for none
    :raises LockedError: if another process writes to the folder
    """

    def __init__(self, folder: Path, keep: int, span: int):
        self.folder, self.keep, self.span = folder, keep, span
        # Outside the folder, so that removing the states does not let a second process in
        self._lock_file = folder.with_name(f"{folder.name}.lock")
        self._lock: Any = None
        earlier = _OPEN.get(folder.resolve())
        if earlier is not None:
            earlier.close()
        self.open_again()

    def close(self) -> None:
        """
        Release the lock, so that others can write to the folder until this store writes again.

        A folder without any state is removed, with its lock file.
        """
        if self._lock is not None:
            if self._owner == os.getpid():  # not in a forked process, which shares the lock
                self._remove_empty()
                unlock(self._lock)
            self._lock.close()
            self._lock = None

    def _remove_empty(self) -> None:
        if is_file_at(self._lock, self._lock_file) and not self.steps():
            with suppress(OSError):  # it has files of others
                (self.folder / _SHARED).rmdir()
                self.folder.rmdir()
                self._lock_file.unlink()

    def open_again(self, shared: Iterable[str] = ()) -> bool:
        """
        Create the folder and take the lock, also if they have been removed or if the store has been closed.

        :param shared: names of shared files
        :return: whether these shared files still exist
        :raises LockedError: if another process, or a newer store of this process, now writes to the folder
        """
        (self.folder / _SHARED).mkdir(parents=True, exist_ok=True)
        if self._lock is None or not is_file_at(self._lock, self._lock_file):
            locked = _lock(self._lock_file)
            self.close()
            self._lock, self._owner = locked, os.getpid()
            _OPEN[self.folder.resolve()] = self
        return all((self.folder / _SHARED / name).is_file() for name in shared)

    def steps(self) -> list[int]:
        """Return the steps of all states, intact or not, newest first."""
        return stored_steps(self.folder)

    def newest(self) -> Stored | None:
        """
        Verify and return the newest intact state.

        :return: the newest intact state, or None if there are no states; warnings name the broken states after it
        :raises BrokenStateError: if there are states, but none is intact
        """
        reasons = []
        for step in self.steps():
            try:
                stored = self._verify(step)
            except BrokenStateError as error:
                reasons.append(str(error))
                continue
            for reason in reasons:
                warnings.warn(f"{reason}; going back to the state of step {step:,}", RuntimeWarning, stacklevel=2)
            return stored
        if reasons:
            raise BrokenStateError(f"No state in {self.folder} is intact: {'; '.join(reasons)}")
        return None

    def at(self, step: int) -> Stored:
        """
        Verify and return the state of a step.

        :return: the state of the step
        :raises ValueError: if there is no state of this step, or if it is broken
        """
        if step not in self.steps():
            there = ", ".join(f"{known:,}" for known in self.steps()) or "none"
            raise ValueError(f"{self.folder} has no state of step {step:,}; there are: {there}")
        return self._verify(step)

    def _read_manifest(self, step: int) -> dict[str, Any]:
        path = self._path(step) / _MANIFEST
        try:
            text, digest = path.read_text().splitlines()
        except (OSError, ValueError) as error:
            raise BrokenStateError(f"{path} is missing or damaged") from error
        if hashlib.sha256(text.encode()).hexdigest() != digest:
            raise BrokenStateError(f"{path} is damaged")
        manifest = json.loads(text)
        if manifest["format"] != _FORMAT:
            raise BrokenStateError(f"{path} is of format {manifest['format']}, this version reads {_FORMAT}")
        return manifest

    def _verify(self, step: int) -> Stored:
        path, manifest = self._path(step), self._read_manifest(step)
        stored = Stored(step, path, manifest["shared"])
        files = {path / name: digest for name, digest in manifest["files"].items()}
        for file, digest in [*files.items(), *((stored.shared_file(n), d) for n, d in stored.shared.items())]:
            try:
                intact = _sha256(file) == digest
            except OSError as error:
                raise BrokenStateError(f"{file} cannot be read ({error.strerror})") from error
            if not intact:
                raise BrokenStateError(f"{file} is damaged")
        return stored

    def write_shared(self, name: str, write: Writer) -> str:
        """
        Write a file that several states need.

        :return: the SHA-256 of the file
        :raises OSError: if the file cannot be written; no part of it stays
        """
        path = self.folder / _SHARED / name
        write_atomically(write, path)
        return _sha256(path)

    def write(self, step: int, files: dict[str, Writer], shared: dict[str, str]) -> Stored:
        """
        Write a state completely or not at all.

        :param files: the function that writes each file, by the file's name
        :param shared: SHA-256 of the shared files that the state needs, by name
        :raises OSError: if the state cannot be written; no part of it stays, and the earlier states stay
        """
        path = self._path(step)
        part = path.with_name(f".{path.name}")
        shutil.rmtree(part, ignore_errors=True)
        try:
            part.mkdir()
            digests = {name: _write(part / name, write) for name, write in files.items()}
            text = json.dumps({"format": _FORMAT, "step": step, "files": digests, "shared": shared})
            manifest = f"{text}\n{hashlib.sha256(text.encode()).hexdigest()}\n"
            _write(part / _MANIFEST, lambda file: file.write_text(manifest))
            sync(part)
            os.replace(part, path)
            sync(self.folder)
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise
        return Stored(step, path, shared)

    def remove_after(self, step: int) -> None:
        """Remove the states after a step, which is that of the restored state."""
        for later in self.steps():
            if later > step:
                self._remove(later)

    def remove_old(self) -> None:
        """
        Remove the states and the shared files that are no longer needed.

        The newest states stay, together with an older one, the one that will take its place, and their shared files.
        """
        kept = _kept(self.steps(), self.keep, self.span)
        for step in self.steps():
            if step not in kept:
                self._remove(step)
        for path in self.folder.glob(".step_*"):
            shutil.rmtree(path, ignore_errors=True)
        needed = set()
        for step in kept:
            with suppress(BrokenStateError):
                needed |= set(self._read_manifest(step)["shared"])
        for path in (self.folder / _SHARED).iterdir():
            if path.name not in needed:
                path.unlink(missing_ok=True)

    def clear(self) -> None:
        """
        Remove all states.

        :raises LockedError: if another process, or a newer store of this process, now writes to the folder
        """
        self.open_again()
        for step in self.steps()[::-1]:
            self._remove(step)

    def remove_all(self) -> None:
        """Remove the folder and its lock file, and release the lock."""
        self.clear()
        shutil.rmtree(self.folder, ignore_errors=True)
        self._lock_file.unlink(missing_ok=True)
        self.close()

    def _remove(self, step: int) -> None:
        path = self._path(step)
        part = path.with_name(f".{path.name}")
        shutil.rmtree(part, ignore_errors=True)
        os.replace(path, part)  # atomically: a half-removed state must not be taken for a broken one
        shutil.rmtree(part, ignore_errors=True)

    def _path(self, step: int) -> Path:
        return self.folder / f"step_{step:012d}"


def _kept(steps: list[int], keep: int, span: int) -> list[int]:
    """
    Choose the states that stay.

    :param steps: timesteps of all states, newest first
    :return: timesteps of the states that stay
    """
    older = steps[: keep - 1 : -1]  # oldest first
    while len(older) > 1 and steps[0] - older[1] >= span:
        del older[0]
    return [*steps[:keep], *(older[:2] if span else [])]


def _write(path: Path, write: Writer) -> str:
    write(path)
    sync(path)
    return _sha256(path)


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _lock(path: Path) -> Any:
    file = lock(path)
    if file is None:
        raise LockedError(f"Another process, or a newer ResumeCallback in this process, writes to {path.parent}")
    return file
