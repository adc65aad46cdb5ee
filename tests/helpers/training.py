"""Small runs of ``train.py``, and what they leave."""

import pytest

from sb3_tdc import TDC
from sb3_tdc.cli import train
from tests.helpers import command_line
from tests.helpers.command_line import SMALL
from tests.tools.runs import digest, files

N = 400


def run_train(folder, *args, env="Hopper-v4", n=N, small=SMALL):
    return command_line.run_train(folder, "--resume-freq", 40, *args, env=env, n=n, small=small)


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
