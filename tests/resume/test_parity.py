"""A run that is stopped in mid-episode and resumed in a new process is the run that was never stopped, bit by bit."""

import importlib.util
import json
import subprocess
import sys

import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tdc.resume.environments import capture_vec_env
from sb3_tdc.resume.kinds.table import KINDS
from sb3_tdc.resume.walk import Capture
from tests.helpers.paths import ROOT
from tests.tools.runs import CASES, CROSS, OTHERS, PYBULLET, bullet

SLOW = [
    *CROSS,
    "readable update",
    "ring overwritten, two environments",
    "Ant-v5",
    "MEOW",
    "SAC",
    "TD3",
    "TQC, gSDE",
    "HER with infos",
    "AdvB-SAC",
]
QUICK = ["Ant-v4-dummy1-plain", "Humanoid-v4-dummy2-gaussian", "Hopper-v4-subproc2-plain"]
QUICK += [name for name in OTHERS if name not in SLOW]

HAS_PYBULLET = importlib.util.find_spec("pybullet_envs_gymnasium") is not None
if HAS_PYBULLET:
    QUICK += ["HumanoidBulletEnv-1", "HopperBulletEnv-2"]
    SLOW += PYBULLET


def run_process(mode, folder, names):
    command = [sys.executable, "-W", "ignore", "-m", "tests.tools.runs", mode, str(folder), *names]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]


def differences(folder, names):
    """
    Run cases in three processes: never stopped, stopped, resumed.

    :return: for each case, the fingerprints that differ; and all fingerprints of the runs that were never stopped
    """
    for mode in ("whole", "stopped", "resumed"):
        run_process(mode, folder, names)
    whole, resumed = (json.loads((folder / f"{mode}.json").read_text()) for mode in ("whole", "resumed"))
    return {
        name: [key for key in whole[name] | resumed[name] if whole[name].get(key) != resumed[name].get(key)]
        for name in names
    }, whole


@pytest.fixture(scope="module")
def quick(request, tmp_path_factory):
    """Run the cases of all selected tests together, as a process takes seconds to start."""
    selected = [item for item in request.session.items if "quick" in getattr(item, "fixturenames", ())]
    return differences(tmp_path_factory.mktemp("parity"), [item.callspec.params["name"] for item in selected])


@pytest.mark.parametrize("name", QUICK)
def test_resumed_is_uninterrupted(quick, name):
    found, whole = quick
    assert found[name] == []
    assert len(whole[name]) > 25  # there was something to compare
    assert whole[name]["number of transitions"] >= CASES[name].steps / CASES[name].n_envs


@pytest.mark.slow
def test_the_whole_cross(tmp_path):
    names = [name for name in SLOW if name not in QUICK]
    assert differences(tmp_path, names)[0] == {name: [] for name in names}


@pytest.mark.skipif(not HAS_PYBULLET, reason="needs PyBullet, which has wheels for Python 3.11 and older only")
@pytest.mark.parametrize("name", ["Thrower", "Pusher", "HumanoidFlagrunHarder"])
def test_a_world_that_pybullet_does_not_save_whole_is_not_captured(name):
    """Restored from PyBullet's own file, a thrown ball, a pushed cylinder and an attacking cube move differently."""
    env = DummyVecEnv([bullet(f"{name}BulletEnv-v0")])
    (state,) = capture_vec_env(Capture(KINDS), env, "env")[0]
    assert "PyBullet does not save all of a world in which" in state["why"]
