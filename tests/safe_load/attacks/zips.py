"""Zips that inflate to many times their size."""

import io
import struct
import zipfile
import zlib

from tests.safe_load.attacks.tools import Op, pth, rewrite


def layers(folder, model):
    """Zeros, compressed a hundredfold in an entry, which is compressed a hundredfold in the model."""
    inner = io.BytesIO()
    with zipfile.ZipFile(inner, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("archive/data.pkl", Op.PROTO + Op.EMPTY_DICT + Op.STOP)
        for i in range(12):
            with archive.open(f"archive/data/{i}", "w") as entry:
                for _ in range(60):
                    entry.write(bytes(4 * 2**20))
    return rewrite(model, folder / "x.zip", deflate=True, **{"policy.pth": inner.getvalue()})


def many_layers(folder, model):
    """The same in every file of tensors."""
    inner = io.BytesIO()
    with zipfile.ZipFile(inner, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", Op.PROTO + Op.EMPTY_DICT + Op.STOP)
        for i in range(4):
            archive.writestr(f"archive/data/{i}", bytes(99 * 2**20)[: 90 * 2**20])
    names = ("policy.pth", "actor.optimizer.pth", "critic.optimizer.pth", "pytorch_variables.pth")
    return rewrite(model, folder / "x.zip", deflate=True, **dict.fromkeys(names, inner.getvalue()))


def text(folder, model):
    return rewrite(model, folder / "x.zip", deflate=True, **{"system_info.txt": bytes(2**29)})


def understated(folder, model, says=60 * 2**20, inflates_to=1000 * 2**20):
    """An entry that inflates to more than it says, with the checksum of what it says."""
    path = rewrite(model, folder / "x.zip", **{"system_info.txt": None})
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive, archive.open("system_info.txt", "w") as entry:
        for _ in range(inflates_to // 2**20):
            entry.write(bytes(2**20))
    content = bytearray(path.read_bytes())
    directory = content.rindex(b"PK\1\2")
    (local,) = struct.unpack_from("<L", content, directory + 42)
    for checksum, size in ((directory + 16, directory + 24), (local + 14, local + 22)):
        struct.pack_into("<L", content, checksum, zlib.crc32(bytes(says)))
        struct.pack_into("<L", content, size, says)
    path.write_bytes(content)
    return path


def crowd(folder, model, n=15_000):
    """Thousands of empty storages in a file of tensors."""
    empty = {f"data_{i:05}": b"" for i in range(n)}
    return rewrite(model, folder / "x.zip", deflate=True, **{"policy.pth": pth(Op.PROTO + Op.NONE + Op.STOP, **empty)})


ATTACKS = {
    "two layers": layers,
    "two layers, four times": many_layers,
    "half a GiB of zeros": text,
    "an entry that inflates to more than it says": understated,
    "fifteen thousand storages": crowd,
}
