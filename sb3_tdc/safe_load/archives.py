"""Reader of zip files, which checks their sizes before it reads their entries."""

import io
import re
import zipfile
from collections import Counter
from typing import IO

from sb3_tdc.common.untrusted import shown
from sb3_tdc.safe_load.budget import Budget, UnsafeFileError

MAX_BYTES = 2**30  # size of a file
MAX_RATIO = 100  # decompressed to compressed bytes of an entry; SB3 itself does not compress
MAX_DIRECTORY = 2**20  # bytes of a zip's list of entries

MODEL_ENTRIES = re.compile(
    r"data|_stable_baselines3_version|system_info\.txt|pytorch_variables\.pth|tensors\.pth|policy\.pth"
    r"|([a-z_]{1,40}\.)?([a-z_]{1,40}_)?optimizer\.pth"
)


def read_archive(file: IO[bytes], allowed: re.Pattern, budget: Budget, only: str | None = None) -> dict[str, bytes]:
    """
    Read the entries of a zip, whose names and sizes are checked before anything is decompressed.

    :param allowed: pattern that the names of entries must match
    :param budget: for everything that is read from the file
    :param only: name of the entry to read; None to read all entries
    :return: the bytes of each entry, by name
    :raises UnsafeFileError: if an entry is unknown, repeated, encrypted, oversized or suspiciously compressed
    """
    if _directory_size(file) > MAX_DIRECTORY:
        raise UnsafeFileError("it is a zip of too many entries")
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        times = Counter(entry.filename for entry in entries)
        for entry in entries:
            budget.check_time()
            if not allowed.fullmatch(entry.filename) or times[entry.filename] > 1:
                raise UnsafeFileError(f"its entry {shown(entry.filename)} is unknown or repeated")
            if entry.flag_bits & 1 or entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise UnsafeFileError(f"its entry {shown(entry.filename)} is encrypted or compressed in an unknown way")
            if entry.file_size > MAX_RATIO * max(entry.compress_size, 100):
                raise UnsafeFileError(f"its entry {shown(entry.filename)} is compressed more than {MAX_RATIO}-fold")
        wanted = [entry for entry in entries if only in (None, entry.filename)]
        budget.take_bytes(sum(entry.file_size for entry in wanted))
        return {entry.filename: _read_entry(archive, entry, budget) for entry in wanted}


def _read_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, budget: Budget) -> bytes:
    """
    Read an entry up to its declared size.

    Without a size, ``read`` decompresses up to 2 GiB before it cuts off the excess.
    """
    budget.check_time()
    with archive.open(entry) as content:
        return content.read(entry.file_size)


def _directory_size(file: IO[bytes]) -> int:
    """
    Return the size of a zip's list of entries in bytes, as declared by the records at the end of the file.

    ``ZipFile`` would read the whole list.
    """
    size = file.seek(0, io.SEEK_END)
    if size > MAX_BYTES:
        raise UnsafeFileError(f"it has {size:,} bytes, more than {MAX_BYTES:,}")
    file.seek(max(size - 98, 0))
    tail = file.read().rjust(98, b"\0")
    zip64, locator, end = tail[:56], tail[56:76], tail[76:]
    if end[:4] != b"PK\5\6" or end[20:] != b"\0\0":
        raise UnsafeFileError("it is not a zip, or is truncated")
    if locator[:4] != b"PK\6\7":
        return int.from_bytes(end[12:16], "little")
    if zip64[:4] != b"PK\6\6" or int.from_bytes(locator[8:16], "little") != size - 98:
        raise UnsafeFileError("it is a damaged zip")
    return int.from_bytes(zip64[40:48], "little")
