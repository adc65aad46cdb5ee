"""Arrays read from files that are intact, damaged, or unreadable."""

import io

import numpy as np
import pytest

from sb3_tdc.common.arrays import read_arrays


def saved(**arrays):
    content = io.BytesIO()
    np.savez(content, **arrays)
    return content.getvalue()


def test_arrays_are_read_by_name(tmp_path):
    (tmp_path / "a.npz").write_bytes(saved(x=[1, 2], y=[[3.0]]))
    y, x = read_arrays(tmp_path / "a.npz", "y", "x")
    assert (x.tolist(), y.tolist()) == ([1, 2], [[3.0]])


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no zip",
        saved(x=[1, 2])[:-30],
        saved(x=[1, 2]).replace(b"\x93NUMPY", b"\x93MUMPY"),
        saved(y=[1, 2]),
        saved(x=np.array([{}], dtype=object)),
    ],
    ids=["empty", "no zip", "cut", "changed", "without x", "objects"],
)
def test_a_damaged_file_is_said_to_be_damaged(tmp_path, content):
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.npz is damaged: it is no \.npz file with x$"):
        read_arrays(tmp_path / "a.npz", "x")


def test_a_file_that_cannot_be_opened(tmp_path):
    (tmp_path / "a.npz").mkdir()
    with pytest.raises(ValueError, match=r"a\.npz cannot be read: Is a directory$"):
        read_arrays(tmp_path / "a.npz", "x")
