"""Fixtures: an uninterrupted run, and one that was stopped."""

import os
import signal

import pytest

from sb3_tdc.runs.callbacks.progress import ProgressCallback
from tests.helpers.training import outcome, run_train


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    assert run_train(folder) == 0
    return outcome(folder / "tdc" / "Hopper-v4_1")


@pytest.fixture
def stop_at(monkeypatch):
    """Send SIGTERM to this process in the middle of a given step."""

    def set_up(step):
        original = ProgressCallback._on_step

        def on_step(self):
            if self.num_timesteps == step:
                os.kill(os.getpid(), signal.SIGTERM)
            return original(self)

        monkeypatch.setattr(ProgressCallback, "_on_step", on_step)

    return set_up


@pytest.fixture
def stopped(tmp_path, stop_at, monkeypatch):
    """The folder of a run that was stopped at step 270."""
    stop_at(270)
    assert run_train(tmp_path) == 130
    monkeypatch.undo()
    return tmp_path / "tdc" / "Hopper-v4_1"
