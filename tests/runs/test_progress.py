"""The bar of a run on terminals of any width."""

import fcntl
import os
import pty
import struct
import sys
import termios
from contextlib import suppress

import pytest

from sb3_tdc import TDC
from sb3_tdc.runs.callbacks.progress import ProgressCallback

pytest.importorskip("tqdm")


def read_all(descriptor):
    with suppress(OSError):  # the other end is closed
        while part := os.read(descriptor, 4096):
            yield part


@pytest.mark.parametrize(("rows", "columns", "width"), [(0, 0, 80), (24, 0, 80), (24, 60, 60)])
def test_a_terminal_without_a_size_has_a_bar_too(monkeypatch, rows, columns, width):
    main, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
    with os.fdopen(terminal, "w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        model = TDC("MlpPolicy", "Pendulum-v1", buffer_size=100, policy_kwargs={"net_arch": [4]}, device="cpu")
        model.learn(20, callback=ProgressCallback(bar=True))
    shown = b"".join(read_all(main)).decode().rstrip().split("\r")[-1]
    os.close(main)
    assert "20.0/20.0" in shown
    assert width - 2 <= len(shown) <= width
