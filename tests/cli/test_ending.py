"""Commands that cannot finish: they end with an exit status and at most one sentence, never with a traceback."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from sb3_tdc.__main__ import main


def run_command(*arguments, **options):
    return subprocess.run([sys.executable, "-m", "sb3_tdc", *arguments], stderr=subprocess.PIPE, text=True, **options)


@pytest.mark.parametrize("is_buffered", [True, False])
def test_a_pipe_that_nobody_reads_ends_a_command_as_it_ends_others(is_buffered):
    reader, writer = os.pipe()
    os.close(reader)
    environment = os.environ | {"PYTHONUNBUFFERED": "" if is_buffered else "1"}
    done = run_command("--help", stdout=writer, env=environment)
    os.close(writer)
    assert (done.returncode, done.stderr) == (128 + 13, "")  # SIGPIPE is 13


def test_a_full_disk_behind_the_output():
    with open("/dev/full", "w") as full:
        done = run_command("--help", stdout=full)
    assert (done.returncode, done.stderr) == (1, "python -m sb3_tdc --help: error: No space left on device\n")


@pytest.mark.parametrize(
    ("error", "status", "sentence"),
    [
        (KeyboardInterrupt(), 130, "Stopped.\n"),
        (PermissionError(13, "Permission denied", "/a/b"), 1, "sb3-tdc plot: error: /a/b: Permission denied\n"),
        (OSError("ffmpeg\nfailed"), 1, "sb3-tdc plot: error: ffmpeg failed\n"),
    ],
)
def test_a_command_that_is_stopped_or_fails(monkeypatch, capsys, error, status, sentence):
    def fail(argv):
        raise error

    monkeypatch.setattr(sys, "argv", ["sb3-tdc"])
    monkeypatch.setitem(sys.modules, "sb3_tdc.cli.plot", SimpleNamespace(main=fail))
    assert main(["plot", "x"]) == status
    assert capsys.readouterr().err == sentence
