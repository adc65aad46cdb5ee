"""Small runs of ``train.py``, and what they leave."""

import pytest

from sb3_tdc import TDC
from sb3_tdc.cli import train
from tests.tools.runs import digest, files

SMALL = ["-params", "policy_kwargs:{net_arch: [16, 16], n_quantiles: 5}", "learning_starts:100", "batch_size:16"]
N = 400


def run_train(folder, *args, env="Hopper-v4", n=N, small=SMALL):
    argv = ["--env", env, "-n", n, "--seed", 1, "-f", folder, "--eval-freq", 150, "--eval-episodes", 2]
    return train.main([str(a) for a in [*argv, "--resume-freq", 40, "--device", "cpu", *small, *args]])


def resume(folder, *args):
    return train.main(["--resume", str(folder), *map(str, args)])


def outcome(folder):
    name = next(folder.glob("*.zip")).stem if not (folder / "Hopper-v4.zip").exists() else "Hopper-v4"
    model = TDC.load(folder / f"{name}.zip", device="cpu")
    return {"weights": digest(model.policy.state_dict()), "steps": model.num_timesteps, **files(folder)}


def fails(call, capsys):
    with pytest.raises(SystemExit) as exit_:
        call()
    assert exit_.value.code == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    return error
