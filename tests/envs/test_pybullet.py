"""PyBullet's tasks: registered on demand, quiet, recorded like the others. Exact resume is in ``tests/resume``."""

import subprocess
import sys

import pytest

pytest.importorskip("pybullet_envs_gymnasium")


def run(*arguments):
    command = [sys.executable, "-m", "sb3_tdc", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


def test_train_and_record(tmp_path):
    """No package has to be named, and neither PyBullet's greeting nor its connection messages are printed."""
    params = ("-params", "learning_starts:20", "batch_size:8", "n_envs:2")
    arguments = ("--env", "HopperBulletEnv-v0", "-f", str(tmp_path), "--no-progress")
    trained = run(
        "train", *arguments, "-n", "60", "--eval-freq", "30", "--num-threads", "1", "--vec-env", "subproc", *params
    )
    assert trained.returncode == 0, trained.stderr
    assert trained.stderr == ""
    assert "argv" not in trained.stdout
    video = tmp_path / "hopper.mp4"
    played = run("enjoy", "--env", "HopperBulletEnv-v0", "-f", str(tmp_path), "-n", "5", "--record", str(video))
    assert played.returncode == 0, played.stderr
    assert video.stat().st_size > 1000
    assert "argv" not in played.stdout + played.stderr


def test_a_misspelt_task(tmp_path):
    refused = run("train", "--env", "HoperBulletEnv-v0", "-f", str(tmp_path))
    assert refused.returncode != 0
    assert "did you mean HopperBulletEnv-v0" in refused.stderr


def test_nothing_is_imported_otherwise():
    code = "import sys, sb3_tdc.envs.make, sb3_tdc.runs.training; sys.exit('pybullet' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
