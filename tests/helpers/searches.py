"""Real searches, in subprocesses."""

import subprocess
import sys

from tests.helpers.paths import ROOT

# A run of a search is evaluated 30 times: with short episodes, in a second
SMALL = ["learning_starts:20", "batch_size:8", "buffer_size:500", "policy_kwargs:{net_arch: [8], n_quantiles: 4}"]
SMALL += ["env_kwargs:{max_episode_steps: 20}"]


def start_search(*arguments):
    return subprocess.Popen(
        [sys.executable, "-W", "ignore", "tune.py", *map(str, arguments)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def arguments(logs, steps=400):
    return ["--env", "Pendulum-v1", "-n", steps, "--seeds", 2, "--logs", logs, "--jobs", 2, "-params", *SMALL]
