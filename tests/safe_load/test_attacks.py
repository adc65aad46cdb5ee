"""Every attack is refused in one printable sentence, within seconds and some hundred MiB, and leaves nothing behind."""

import json
import os
import subprocess
import sys

import pytest

from tests.helpers.paths import ROOT
from tests.helpers.saved_models import MODELS
from tests.safe_load.attacks import ATTACKS
from tests.safe_load.attacks.__main__ import peak, reset_peak


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """Return the outcome of every attack, opened in a child process whose memory is measured."""
    folder = tmp_path_factory.mktemp("attacks")
    (folder / "empty").mkdir()
    MODELS["tdc-stochastic"]().save(folder / "model.zip")
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "tests.safe_load.attacks", str(folder / "model.zip")]
    child = subprocess.run(command, cwd=folder / "empty", env=environment, capture_output=True, text=True, check=False)
    assert child.returncode == 0, child.stderr
    return json.loads(child.stdout)


def test_memory_is_measured_for_each_attack_alone():
    large = b"x" * 2**28
    del large
    # Pieces from the heap, which malloc gives back to the kernel only from its top
    pieces = [b"x" * 2**16 for _ in range(2**12)]
    top = pieces.pop()
    del pieces
    before = reset_peak()
    small = b"x" * 2**27
    del small, top
    assert 100 < (peak() - before) / 1024 < 150


@pytest.mark.parametrize("name", ATTACKS)
def test_an_attack(outcomes, name):
    outcome = outcomes[name]
    message = outcome["message"].strip()
    # Two kinds may open: a field that is not read, and an entry of which only the stated size is read
    assert message != "opened" or name.endswith(("in _last_obs", "inflates to more than it says"))
    assert message.isprintable(), message
    assert len(message) < 1500
    assert "Traceback" not in message
    assert outcome["seconds"] < 5
    assert outcome["mebibytes"] < 500
    assert outcome["left"] == []
