"""Readers of regular files, which refuse pipes, devices and folders."""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from sb3_tdc.safe_load.budget import UnsafeFileError


@contextmanager
def open_regular(path: str | Path, limit: int) -> Iterator[tuple[IO[bytes], int]]:
    """
    Open a regular file for reading.

    :param limit: the largest allowed size in bytes
    :return: the file, and its size in bytes
    :raises OSError: if the file does not exist
    :raises UnsafeFileError: if it is not a regular file, or is larger
    """
    # Without O_NONBLOCK, opening a FIFO would wait until something writes into it
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise UnsafeFileError("it is not a regular file")
        if status.st_size > limit:
            raise UnsafeFileError(f"it has {status.st_size:,} bytes, more than {limit:,}")
        yield file, status.st_size


def read_text(path: str | Path, limit: int) -> str:
    """
    Return the text of a small file.

    :raises ValueError: if the file is missing, larger, not regular or not text; the error names it
    """
    try:
        with open_regular(path, limit) as (file, _):
            return file.read(limit + 1).decode()
    except (OSError, UnicodeDecodeError, UnsafeFileError) as error:
        raise ValueError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from error
