"""Zips that grow."""

import io
import zipfile

from tests.safe_load.attacks.tools import Op, rewrite


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


ATTACKS = {"two layers": layers, "two layers, four times": many_layers, "half a GiB of zeros": text}
