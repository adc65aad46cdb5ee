"""The settings of a run, checked before anything is made, and again when the run is resumed."""

import pytest
import torch as th

from sb3_tdc.cli import train
from sb3_tdc.common import plain_yaml
from sb3_tdc.common.checks import check_device
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.runs.settings import RunSettings, check_settings
from tests.helpers.training import fails


@pytest.mark.parametrize(
    ("flag", "value", "allowed"),
    [
        ("--eval-freq", -2, "at least 0 (or -1: none, as 0)"),
        ("--save-freq", -5, "at least 0 (or -1: only at the end, as 0)"),
        ("--resume-freq", 0, "at least 1 (or -1: none)"),
        ("--log-interval", -2, "at least 0 (or -1: 4, or the number of environments if that is larger)"),
        ("--num-threads", 0, "at least 1 (or -1: at most two)"),
        ("--n-eval-envs", -1, "at least 1"),
        ("--verbose", -1, "at least 0"),
        ("--seed", 2**32 - 2**16 + 1, "0 to 4294901760 (or -1: a random one)"),
    ],
)
def test_numbers_that_mean_nothing_are_refused(tmp_path, capsys, flag, value, allowed):
    error = fails(lambda: train.main(["--env", "Pendulum-v1", "-f", str(tmp_path), flag, str(value)]), capsys)
    assert f"error: {flag} must be {allowed}, got {value}\n" in error
    assert list(tmp_path.iterdir()) == []


def test_what_turns_something_off_is_allowed():
    """−1 is RL Zoo's convention."""
    check_settings(RunSettings(eval_freq=-1, save_freq=-1, resume_freq=-1, log_interval=0, num_threads=-1, seed=-1))
    check_settings(RunSettings(eval_freq=0, save_freq=0))
    assert RunSettings(resume_freq=-1).writes_states is False
    assert RunSettings().writes_states is True


@pytest.mark.parametrize(
    ("n_gpus", "device", "allowed"),
    [(0, "cuda", "auto, cpu"), (0, "foo", "auto, cpu"), (2, "cuda:2", "auto, cpu, cuda, cuda:0, cuda:1")],
)
def test_a_device_that_is_not_there_is_never_replaced_by_another(monkeypatch, n_gpus, device, allowed):
    monkeypatch.setattr(th.cuda, "device_count", lambda: n_gpus)
    monkeypatch.setattr(th.backends.mps, "is_available", lambda: False)
    with pytest.raises(ValueError, match=f"^--device must be one of {allowed} on this machine, got '{device}'$"):
        check_device("--device", device)
    for there in allowed.split(", "):
        check_device("--device", there)


@pytest.fixture
def run(tmp_path):
    """The folder of a run that was stopped at its start."""
    folder = RunFolder.create(tmp_path, "tdc", "Pendulum-v1")
    config = {"n_timesteps": 200, "learning_starts": 100, "batch_size": 16, "policy_kwargs": {"net_arch": [8]}}
    settings = RunSettings(env="Pendulum-v1", seed=1, log_folder=str(tmp_path), eval_freq=-1, device="cpu")
    folder.write_config(config, settings.as_plain())
    return folder


@pytest.mark.parametrize(
    ("edit", "sentence"),
    [
        ({"eval_freq": "often"}, "eval_freq must be an integer, got 'often'"),
        ({"eval_freq": -3}, "eval_freq must be at least 0 (or -1: none, as 0), got -3"),
        ({"eval_freq": 1.5}, "eval_freq must be an integer, got 1.5"),
        ({"resume_freq": "x"}, "resume_freq must be an integer or null, got 'x'"),
        ({"vec_env": "threads"}, "vec_env must be one of dummy, subproc, gymnasium, got 'threads'"),
        ({"trust": "yes"}, "trust must be true or false, got 'yes'"),
        ({"seed": -1}, "seed must be that of the run, got -1"),
        ({"seed": 2**32 - 2**16 + 1}, "seed must be 0 to 4294901760 (or -1: a random one), got 4294901761"),
        ({"device": "foo"}, "device must be one of auto, cpu"),
        ({"env_kwargs": [1]}, "env_kwargs must be a mapping, got "),
        ({"env": None}, "env must be a text, got nothing"),
        ({"algo": "tcd"}, "algo must be one of tdc, "),
        ({"eval_env_kwargs": 3}, "eval_env_kwargs must be a mapping, got 3"),
    ],
    ids=str,
)
def test_arguments_that_were_edited_are_checked_like_flags(run, capsys, edit, sentence):
    path = run.path / run.env_name / "args.yml"
    edited = {**run.args, **edit}
    path.write_text(plain_yaml.dump({name: value for name, value in edited.items() if value is not None}))
    before = sorted(run.path.rglob("*"))
    assert f"{path}: {sentence}" in fails(lambda: train.main(["--resume", str(run.path)]), capsys)
    assert sorted(run.path.rglob("*")) == before


def test_a_flag_replaces_what_is_not_there_any_more(run, capsys):
    path = run.path / run.env_name / "args.yml"
    path.write_text(plain_yaml.dump({**run.args, "device": "cuda:99"}))
    assert f"{path}: device must be one of" in fails(lambda: train.main(["--resume", str(run.path)]), capsys)
    error = fails(lambda: train.main(["--resume", str(run.path), "--device", "foo"]), capsys)
    assert "error: --device must be one of" in error
    assert train.main(["--resume", str(run.path), "--device", "cpu"]) == 0
