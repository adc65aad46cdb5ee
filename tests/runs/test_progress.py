"""The bar of a run on terminals of any width, and the lines elsewhere."""

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


def test_a_line_has_no_rate_of_hardly_any_steps(capsys):
    """Right after a resume, there is often a single step, and then an evaluation of several seconds."""
    model = TDC("MlpPolicy", "Pendulum-v1", buffer_size=100, policy_kwargs={"net_arch": [4]}, device="cpu")
    progress = ProgressCallback(bar=False)
    model.learn(99, callback=progress)
    model.learn(101, callback=progress, reset_num_timesteps=False)
    model.num_timesteps = 100
    progress.show_line("eval 1.0")
    model.num_timesteps = 200
    progress.show_line("eval 2.0")
    first, second = capsys.readouterr().out.splitlines()
    assert first.split("|") == ["      100 steps  50.0% ", " eval 1.0"]
    assert [part.split()[-1] for part in second.split("|")] == ["100.0%", "steps/s", "left", "2.0"]
