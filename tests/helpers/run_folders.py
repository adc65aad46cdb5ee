"""Run folders as training leaves them, made without training."""

import json
import zipfile

import numpy as np
import pandas as pd

from sb3_tdc.hyperparams import hyperparams_file, read_entry
from sb3_tdc.runs.folder import RunFolder

NETWORKS = {"net_arch": [256, 256], "n_quantiles": 64}


def shipped(algo="tdc", env_id="Hopper-v4", n_timesteps=1000):
    """Return the entry of ``hyperparams/``, shortened as the matrix shortens it."""
    try:
        entry, _ = read_entry(hyperparams_file(algo), env_id)
    except ValueError:  # an environment of another package
        entry = {}
    short = {"learning_starts": min(entry["learning_starts"], n_timesteps // 10)} if "learning_starts" in entry else {}
    return {**entry, **short, "n_timesteps": n_timesteps}


def make_run(
    folder, algo="tdc", env_id="Hopper-v4", seed=1, steps=1000, args=(), returns=((1.0, 3.0),), log=None, **config
):
    """
    Make the folder of a run.

    :param steps: number of steps taken; None if no model was saved
    :param log: columns of progress.csv, at equal distances
    """
    run = RunFolder.create(folder, algo, env_id)
    config = {**shipped(algo, env_id, config.get("n_timesteps", 1000)), **config}
    run.write_config(config, {"algo": algo, "env": env_id, "seed": seed, **dict(args)})
    timesteps = np.linspace(0, steps or 500, len(returns) + 1)[1:]
    np.savez(run.path / "evaluations.npz", timesteps=timesteps, results=returns)
    if steps is not None:
        with zipfile.ZipFile(run.model, "w") as archive:
            archive.writestr("data", json.dumps({"num_timesteps": steps}))
            archive.writestr("system_info.txt", "- OS: of the test\n- Python: 3\n")
    if log is not None:
        table = pd.DataFrame(log)
        table.insert(0, "time/total_timesteps", np.linspace(0, steps, len(table) + 1)[1:])
        table.to_csv(run.path / "progress.csv", index=False)
    return run
