"""Functions that put zips, fields, pickles and files of tensors together."""

import base64
import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any


def rewrite(model: Path, target: Path, deflate: bool = False, **entries: bytes | str | None) -> Path:
    """Write a copy of a zip with some of its entries replaced or added; an entry that is None is left out."""
    compression = zipfile.ZIP_DEFLATED if deflate else zipfile.ZIP_STORED
    with zipfile.ZipFile(model) as old, zipfile.ZipFile(target, "w", compression) as new:
        for name, content in {**{name: old.read(name) for name in old.namelist()}, **entries}.items():
            if content is not None:
                new.writestr(name, content)
    return target


def fields_of(model: Path) -> dict[str, Any]:
    with zipfile.ZipFile(model) as archive:
        return json.loads(archive.read("data"))


def with_fields(model: Path, target: Path, **fields: Any) -> Path:
    """Write a copy with some fields of ``data`` replaced; a field that is ``...`` is left out."""
    data = {**fields_of(model), **fields}
    return rewrite(model, target, data=json.dumps({name: v for name, v in data.items() if v is not ...}))


def pickled(raw: bytes) -> dict[str, str]:
    """A field whose pickle is these bytes."""
    return {":type:": "?", ":serialized:": base64.b64encode(raw).decode()}


def pth(tree: bytes, **records: bytes) -> bytes:
    """A file of tensors with this pickle and these records (``data_0`` is that of storage 0)."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("archive/data.pkl", tree)
        archive.writestr("archive/version", "3")
        for name, content in records.items():
            archive.writestr(f"archive/{name.replace('_', '/')}", content)
    return file.getvalue()


class Op:
    """Opcodes of a pickle, put together by hand."""

    PROTO, STOP, MARK, TUPLE, DICT, LIST = b"\x80\x02", b".", b"(", b"t", b"d", b"l"
    EMPTY_TUPLE, EMPTY_DICT, EMPTY_LIST, NONE, TRUE, FALSE = b")", b"}", b"]", b"N", b"\x88", b"\x89"
    REDUCE, BUILD, APPEND, APPENDS, SETITEM, SETITEMS, PERSID, POP = b"R", b"b", b"a", b"e", b"s", b"u", b"Q", b"0"

    @staticmethod
    def integer(value: int) -> bytes:
        return pickle.dumps(value, 2)[2:-1]

    @staticmethod
    def text(value: str) -> bytes:
        raw = value.encode()
        return b"X" + len(raw).to_bytes(4, "little") + raw

    @staticmethod
    def name(module: str, attribute: str) -> bytes:
        return f"c{module}\n{attribute}\n".encode()

    @staticmethod
    def put(number: int) -> bytes:
        return b"r" + number.to_bytes(4, "little")

    @staticmethod
    def get(number: int) -> bytes:
        return b"j" + number.to_bytes(4, "little")

    @staticmethod
    def tuple_of(*parts: bytes) -> bytes:
        return b"(" + b"".join(parts) + b"t"


def tensor(
    size: int, shape: tuple[int, ...], stride: tuple[int, ...], key: str = "0", kind: str = "FloatStorage", more=b""
) -> bytes:
    """The opcodes of one tensor. :param more: opcodes of arguments after the sixth"""
    storage = Op.tuple_of(Op.text("storage"), Op.name("torch", kind), Op.text(key), Op.text("cpu"), Op.integer(size))
    hooks = Op.name("collections", "OrderedDict") + Op.EMPTY_TUPLE + Op.REDUCE
    numbers = [Op.tuple_of(*map(Op.integer, part)) for part in (shape, stride)]
    args = Op.tuple_of(storage + Op.PERSID, Op.integer(0), *numbers, Op.FALSE, hooks, more)
    return Op.name("torch._utils", "_rebuild_tensor_v2") + args + Op.REDUCE
