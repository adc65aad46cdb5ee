"""Output that cannot be written: it never ends a run, and the run loses nothing else."""

import io
import os
import signal
import subprocess
import sys
import time
import warnings

import numpy as np
import pytest

import sb3_tdc
from sb3_tdc import TDC
from sb3_tdc.common.output import harmless_output, warnings_as_sentences
from tests.helpers.paths import ROOT

SETTINGS = "--eval-freq 100 --eval-episodes 1 --seed 1 -params learning_starts:50 buffer_size:1000"
OPTIONS = ["--env", "Pendulum-v1", *SETTINGS.split()]


def test_warnings_of_this_package_are_sentences():
    usual = warnings.formatwarning
    others = ("It diverges.", RuntimeWarning, np.__file__, 7)
    with warnings_as_sentences():
        assert warnings.formatwarning("It ends.", RuntimeWarning, sb3_tdc.__file__, 7) == "Warning: It ends.\n"
        assert warnings.formatwarning(*others) == usual(*others)
    assert warnings.formatwarning is usual


class Broken(io.StringIO):
    def __init__(self, error):
        super().__init__()
        self.error = error

    def write(self, text=""):
        raise self.error

    flush = write


def start(folder, steps, environment=None, **streams):
    command = [sys.executable, "-W", "ignore", str(ROOT / "train.py"), *OPTIONS, "-n", str(steps), "-f", str(folder)]
    # The suite itself may run under nohup, and a child would inherit that SIGHUP is ignored
    streams = {"preexec_fn": lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL), **streams}
    return subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "1", **(environment or {})}, **streams)


def wait_for(path):
    deadline = time.monotonic() + 60
    while not path.exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    assert path.exists()


@pytest.mark.parametrize("error", [BrokenPipeError(), OSError(28, "No space left"), ValueError("closed file")], ids=str)
def test_what_cannot_be_written_is_dropped(error, monkeypatch):
    monkeypatch.setattr(sys, "stdout", Broken(error))
    with harmless_output():
        print("lost", flush=True)
    with pytest.raises(type(error)):
        print("lost")


def test_letters_that_cannot_be_encoded_are_replaced(monkeypatch):
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="ascii"))
    with harmless_output():
        print("1 ± 2 steps", flush=True)
    assert raw.getvalue() == b"1 ? 2 steps\n"


def test_a_stream_that_was_closed_from_the_start_stays_away(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    with harmless_output():
        print("nowhere")
    assert sys.stdout is None


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_signal_saves_although_the_reader_of_the_pipe_is_gone(tmp_path, number):
    """As with ``train.py … 2>&1 | tee log`` and Ctrl-C, which ends ``tee`` first, or a terminal that is closed."""
    reader, writer = os.pipe()
    process = start(tmp_path, 1_000_000, stdout=writer, stderr=writer)
    os.close(writer)
    run = tmp_path / "tdc" / "Pendulum-v1_1"
    wait_for(run / "evaluations.npz")
    os.close(reader)
    process.send_signal(number)
    assert process.wait(60) == 130
    assert TDC.load(run / "Pendulum-v1.zip").num_timesteps >= 100
    assert any((run / "resume").iterdir())


def test_a_full_disk_behind_the_output_and_a_poor_terminal_end_nothing(tmp_path):
    with open("/dev/full", "w") as full:
        process = start(tmp_path, 250, {"PYTHONIOENCODING": "ascii", "LC_ALL": "C"}, stdout=full, stderr=full)
        assert process.wait(60) == 0
    assert TDC.load(tmp_path / "tdc" / "Pendulum-v1_1" / "Pendulum-v1.zip").num_timesteps == 250


def test_a_hangup_does_not_end_a_run_started_with_nohup(tmp_path):
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    ignore = lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN)  # noqa: E731
    process = start(tmp_path, 400, preexec_fn=ignore, **quiet)
    wait_for(tmp_path / "tdc" / "Pendulum-v1_1" / "evaluations.npz")
    process.send_signal(signal.SIGHUP)
    assert process.wait(60) == 0
