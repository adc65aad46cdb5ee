"""Limits on the cost of reading one file, for all of its parts together."""

import time

MAX_OPCODES = 1_000_000  # SB3 writes a few thousand for a model
MAX_NODES = 500_000  # values, each counted as often as it is reached; infos with that many use about MAX_OPCODES
MAX_SECONDS = 4.0  # of the thread's processor time, in addition to the time for the bytes of the file
BYTES = 2**28  # that are granted to every file, however small
GROWTH = 8  # further bytes for each byte of the file: its entries, copies, arrays
BYTES_PER_SECOND = 2**25


class UnsafeFileError(ValueError):
    """Error for a file that is not opened, with the reason in one sentence: it holds more than data, or is damaged."""


class Budget:
    """
    Budget of one file, created when the file is opened and passed to everything that reads from it, in one thread.

    :param size: size of the file in bytes
    """

    def __init__(self, size: int):
        self.opcodes, self.nodes = MAX_OPCODES, MAX_NODES
        self.bytes = BYTES + GROWTH * size
        self.deadline = time.thread_time() + MAX_SECONDS + size / BYTES_PER_SECOND

    def take_opcode(self) -> None:
        """
        Pay for one operation of a pickle.

        :raises UnsafeFileError: if the pickles of the file have too many operations, or take too much time
        """
        self.opcodes -= 1
        if self.opcodes < 0:
            raise UnsafeFileError(f"pickles of more than {MAX_OPCODES:,} operations")
        if self.opcodes % 1024 == 0:
            self.check_time()

    def take_nodes(self, n: int) -> None:
        """
        Pay for values.

        :raises UnsafeFileError: if the file has too many values
        """
        self.nodes -= n
        if self.nodes < 0:
            raise UnsafeFileError(f"more than {MAX_NODES:,} values")

    def take_bytes(self, n: int) -> None:
        """
        Pay for bytes before they are decompressed, copied or allocated.

        :raises UnsafeFileError: if all of these bytes together are too many, or reading has taken too long
        """
        self.bytes -= n
        if self.bytes < 0:
            raise UnsafeFileError("it would take far more memory than it has bytes")
        self.check_time()

    def check_time(self) -> None:
        """
        Check the time that has been spent on reading the file.

        :raises UnsafeFileError: if reading has taken too long
        """
        if time.thread_time() > self.deadline:
            raise UnsafeFileError("it takes too long to read")
