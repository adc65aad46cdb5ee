"""Output that never ends a run: not at a closed pipe or terminal, on a full disk, or with a missing character."""

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).parents[1]


class _HarmlessStream:
    """
    Text stream that drops text that it cannot write, and replaces characters that it cannot encode.

    :param stream: standard output or standard error
    """

    def __init__(self, stream: Any):
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            self._stream.write(text)
        except UnicodeEncodeError:
            encoding = self._stream.encoding
            self.write(text.encode(encoding, errors="replace").decode(encoding))
        except (OSError, ValueError):  # ValueError: the stream is closed
            pass
        return len(text)

    def flush(self) -> None:
        with suppress(OSError, ValueError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def warnings_as_sentences() -> Iterator[None]:
    """Print the warnings of this package without the file, the line and the code that they come from."""
    usual: Any = warnings.formatwarning

    def format_warning(message: Any, category: type[Warning], filename: str, lineno: int, line: Any = None) -> str:
        if Path(filename).is_relative_to(_PACKAGE):
            return f"Warning: {message}\n"
        return usual(message, category, filename, lineno, line)

    warnings.formatwarning = format_warning
    try:
        yield
    finally:
        warnings.formatwarning = usual


@contextmanager
def harmless_output() -> Iterator[None]:
    """
    Keep printing in this block from raising errors.

    Output that cannot be flushed at the end of the block raises no error when the process exits, either.
    """
    streams = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (stream and _HarmlessStream(stream) for stream in streams)  # None if closed from the start
    try:
        yield
    finally:
        sys.stdout, sys.stderr = streams
        for stream in streams:
            _drop_what_cannot_be_flushed(stream)


def _drop_what_cannot_be_flushed(stream: Any) -> None:
    try:
        if stream is not None:
            stream.flush()
    except (OSError, ValueError):
        with suppress(OSError, ValueError):  # Python flushes again at exit, and would fail then
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def write_from_handler(text: str) -> None:
    """Write to standard error from a signal handler, which may have interrupted another write to it."""
    with suppress(OSError):
        os.write(2, text.encode("ascii", errors="replace"))
