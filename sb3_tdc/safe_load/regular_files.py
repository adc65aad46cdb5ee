"""Regular files alone: what is a pipe, a device or a folder is not opened."""

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
    Open a file to read it.

    :param limit: bytes that it may have
    :return: the file, and its size
    :raises OSError: if there is none
    :raises UnsafeFileError: if it is no regular file, or is larger
    """
    # Otherwise opening a FIFO waits until something writes into it
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

    :raises ValueError: if it is larger, no regular file or no text; with its name
    """
    try:
        with open_regular(path, limit) as (file, _):
            return file.read(limit + 1).decode()
    except (OSError, UnicodeDecodeError, UnsafeFileError) as error:
        raise ValueError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from error
