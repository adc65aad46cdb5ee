"""What reading one file may cost, all of its parts together."""

import time

MAX_OPCODES = 1_000_000  # SB3 writes some thousands for a model
MAX_NODES = 500_000  # values, each counted as often as it is reached; infos of so many take about all operations
MAX_SECONDS = 4.0  # beyond what the bytes of a large file take
BYTES = 2**28  # that a small file may grow to
GROWTH = 8  # times the size of a large one: entries, copies, arrays
BYTES_PER_SECOND = 2**25


class UnsafeFileError(ValueError):
    """A file that is not opened, with the reason in one sentence: it asks for more than data, or it is damaged."""


class Budget:
    """
    Made where a file is opened, and handed to everything that reads from it.

    :param size: bytes of the file
    """

    def __init__(self, size: int):
        self.opcodes, self.nodes = MAX_OPCODES, MAX_NODES
        self.bytes = BYTES + GROWTH * size
        self.deadline = time.monotonic() + MAX_SECONDS + size / BYTES_PER_SECOND

    def take_opcode(self) -> None:
        """
        Pay for an operation of a pickle.

        :raises UnsafeFileError: if a pickle is too long, or takes too much time
        """
        self.opcodes -= 1
        if self.opcodes < 0:
            raise UnsafeFileError(f"pickles of more than {MAX_OPCODES:,} operations")
        if self.opcodes % 1024 == 0:
            self.check_time()

    def take_nodes(self, n: int) -> None:
        """
        Pay for values.

        :raises UnsafeFileError: if the values would be too many
        """
        self.nodes -= n
        if self.nodes < 0:
            raise UnsafeFileError(f"more than {MAX_NODES:,} values")

    def take_bytes(self, n: int) -> None:
        """
        Pay for bytes that are decompressed, copied or made.

        :raises UnsafeFileError: if what is decompressed, copied and made would be too large
        """
        self.bytes -= n
        if self.bytes < 0:
            raise UnsafeFileError("it would take far more memory than it has bytes")
        self.check_time()

    def check_time(self) -> None:
        """
        Check the time that reading has taken.

        :raises UnsafeFileError: if reading has taken too long
        """
        if time.monotonic() > self.deadline:
            raise UnsafeFileError("it takes too long to read")
