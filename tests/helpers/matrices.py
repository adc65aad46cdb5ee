"""Real matrices and searches, in subprocesses."""

import subprocess
import sys
from pathlib import Path

from tests.helpers.paths import ROOT

SMALL = {"learning_starts": 20, "batch_size": 8, "buffer_size": 500}
SMALL_TDC = {**SMALL, "policy_kwargs": {"net_arch": [8], "n_quantiles": 4}}

# The matrix command with custom suites: small networks on Pendulum, and one run that fails
CODE = f"""
import sys
from sb3_tdc.experiments.suites import SUITES, Cell
from sb3_tdc.cli.matrix import main
SMALL = {{**{SMALL_TDC}, "env_kwargs": {{"max_episode_steps": 60}}}}  # short evaluations
SUITES["fig1"] = [Cell("tdc", "Pendulum-v1", SMALL), Cell("tdc", "Pendulum-v1", {{**SMALL, "lam": 0.0}})]
SUITES["fig2"] = [Cell("tdc", "Pendulum-v1", {{**SMALL, "lam": -1.0}}), Cell("tdc", "Pendulum-v1", SMALL)]
sys.exit(main())
"""


def start_matrix(suite, logs, *arguments):
    command = [sys.executable, "-W", "ignore", "-c", CODE, suite, "--seeds", "1", "--logs", str(logs), *arguments]
    return subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


def finish(process):
    return process.communicate(timeout=300)[0], process.returncode


def descendants(pid):
    children = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True).stdout.split()
    return [int(pid), *(p for child in children for p in descendants(child))]


def runs_of(pid):
    """Return the ids of the run processes below a process, without Ray's own, which notice late that it is gone."""
    family = {other: Path(f"/proc/{other}/cmdline").read_bytes() for other in descendants(pid)}
    return [other for other, command in family.items() if b"\0sb3_tdc\0job\0" in command]


def is_running(pid):
    try:
        return (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
