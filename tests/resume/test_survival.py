"""
What may happen to a run besides a kill.

Signals to its group, a full disk, removed folders, edited files, clocks that are set back, environments that fail.
"""

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium.envs.classic_control import PendulumEnv
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tdc import TDC
from sb3_tdc.resume import ResumeCallback, stored_steps
from sb3_tdc.runs.callbacks.progress import ProgressCallback
from sb3_tdc.runs.callbacks.stopping import StopOnSignalCallback, StoppableEvaluation
from sb3_tdc.safe_load import load_normalization
from tests.helpers import failing_envs  # noqa: F401, since it registers them
from tests.helpers.command_line import SMALL_ANY
from tests.helpers.paths import ROOT
from tests.helpers.training import fails, outcome, resume, run_train


def no_space(*args, **kwargs):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


# ---------------------------------------------------------------- signals


@pytest.mark.parametrize(
    ("number", "times"), [(signal.SIGTERM, 3), pytest.param(signal.SIGHUP, 1, marks=pytest.mark.slow)]
)
def test_a_signal_to_the_whole_group_loses_nothing_of_a_run_with_processes(tmp_path, number, times):
    command = [sys.executable, "-W", "ignore", str(ROOT / "train.py"), "--env", "Pendulum-v1", "--vec-env", "subproc"]
    command += ["-n", "100000", "-f", str(tmp_path), "--eval-freq", "300", "--resume-freq", "50000"]
    command += ["--num-threads", "1", "-params", "n_envs:2", "learning_starts:50", "buffer_size:1000", "batch_size:8"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    for line in process.stdout:
        if " eval " in line:
            break
    for _ in range(times):
        os.killpg(process.pid, number)
        time.sleep(0.02)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "Traceback" not in err
    run = tmp_path / "tdc" / "Pendulum-v1_1"
    (step,) = [step for step in stored_steps(run / "resume") if step > 0][:1]
    assert f"To continue from step {step:,}" in out
    deadline = time.monotonic() + 10
    while (left := _processes_of_session(process.pid)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert left == ""


def _processes_of_session(session):
    return subprocess.run(["ps", "-o", "args=", "-s", str(session)], capture_output=True, text=True, check=False).stdout


def test_a_second_ctrl_c_interrupts_and_a_second_sigterm_does_not(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    stop = StopOnSignalCallback()
    with stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.requested
        now[0] = 10.0
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGHUP)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    stop = StopOnSignalCallback()
    with stop:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)  # of the same key press: one to the group, one to the process
        now[0] += 1
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def train_in_process(env_id, *options):
    """Train on environments that have processes of their own."""
    command = [sys.executable, "-W", "ignore", ROOT / "train.py", "--env", env_id, "--vec-env", "subproc"]
    command += ["--gym-packages", "tests.helpers.failing_envs", *options]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        list(map(str, command)), capture_output=True, text=True, timeout=90, env=environment, check=False
    )


def test_processes_that_ignore_signals_do_not_outlive_a_run_that_fails(tmp_path):
    ended = train_in_process("Dies-v0", "-f", tmp_path / "logs", "-params", "n_envs:2")
    assert ended.returncode == 2
    assert "Dies-v0 cannot be made: RuntimeError: no licence (" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert not list((tmp_path / "logs").rglob("args.yml"))


def test_a_stop_during_an_evaluation_continues_right_before_it(tmp_path, monkeypatch, whole, capsys):
    log = StoppableEvaluation._log_success_callback

    def signalled(self, *args):
        if self.num_timesteps == 300:
            os.kill(os.getpid(), signal.SIGTERM)
        log(self, *args)

    monkeypatch.setattr(StoppableEvaluation, "_log_success_callback", signalled)
    assert run_train(tmp_path) == 130
    monkeypatch.undo()
    folder = tmp_path / "tdc" / "Hopper-v4_1"
    assert "To continue from step 299:" in capsys.readouterr().out  # the evaluation is of step 300
    assert resume(folder) == 0
    assert outcome(folder) == whole


# ---------------------------------------------------------------- a full disk


def test_a_state_that_cannot_be_written_is_tried_again_when_the_next_is_due(tmp_path, monkeypatch):
    tried = []

    def full(self, step):
        tried.append(step)
        no_space()

    monkeypatch.setattr(ResumeCallback, "_write", full)
    with pytest.warns(RuntimeWarning, match="The next is due in 40 steps"):
        assert run_train(tmp_path, "--eval-freq", -1, n=150) == 0
    assert tried == [0, 40, 80, 120]


def test_a_run_whose_model_cannot_be_saved_says_so_and_can_be_resumed(tmp_path, monkeypatch, whole, capsys):
    monkeypatch.setattr(TDC, "save", lambda self, path: TDC_SAVE(self, path) if "best" in str(path) else no_space())
    assert run_train(tmp_path) == 1
    monkeypatch.undo()
    folder, error = tmp_path / "tdc" / "Hopper-v4_1", capsys.readouterr().err
    assert "The model of step 400 could not be saved: [Errno 28] No space left on device\n" in error
    assert f"train --resume {folder}" in error
    assert resume(folder) == 0
    assert outcome(folder) == whole


TDC_SAVE = TDC.save


def test_a_folder_that_cannot_be_written_to_is_a_sentence_and_nothing_stays(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(Path, "write_text", no_space)
    error = fails(lambda: run_train(tmp_path), capsys)
    assert "No run folder can be made in" in error
    assert "No space left" in error
    assert list(tmp_path.iterdir()) == []


class FailsInEvaluation(PendulumEnv):
    made = 0

    def __init__(self):
        super().__init__()
        type(self).made += 1
        self.number = type(self).made

    def step(self, action):
        if self.number % 2 == 0:
            raise ConnectionResetError("the simulator has gone")
        return super().step(action)


def test_an_error_of_a_simulator_in_an_evaluation_is_not_taken_for_a_full_disk(tmp_path, capsys):
    gym.register("FailsInEvaluation-v0", FailsInEvaluation, max_episode_steps=20)
    assert run_train(tmp_path, env="FailsInEvaluation-v0") == 1
    error = capsys.readouterr().err
    assert "Training failed at step 150: step() raised ConnectionResetError: the simulator has gone (" in error
    assert not (tmp_path / "tdc" / "FailsInEvaluation-v0_1" / "FailsInEvaluation-v0.zip").exists()


def test_an_evaluation_that_cannot_be_written_is_named_and_training_continues(tmp_path, monkeypatch):

    write = np.savez
    monkeypatch.setattr(
        np, "savez", lambda path, **arrays: no_space() if "timesteps" in arrays else write(path, **arrays)
    )
    with pytest.warns(UserWarning, match="evaluation of step 150 was not written: .*No space left"):
        assert run_train(tmp_path, n=200) == 0


# ---------------------------------------------------------------- removed, or edited


@pytest.fixture
def at_step(monkeypatch):
    """Call an action in the middle of a given step."""

    def set_up(step, action):
        original = ProgressCallback._on_step

        def on_step(self):
            if self.num_timesteps == step:
                action()
            return original(self)

        monkeypatch.setattr(ProgressCallback, "_on_step", on_step)

    return set_up


def test_states_that_are_removed_under_a_run_are_written_again_whole(tmp_path, at_step, monkeypatch, whole):
    folder = tmp_path / "tdc" / "Hopper-v4_1"

    def remove_then_stop():
        shutil.rmtree(folder / "resume")
        (folder / "resume.lock").unlink()
        os.kill(os.getpid(), signal.SIGTERM)

    at_step(270, remove_then_stop)
    assert run_train(tmp_path) == 130
    monkeypatch.undo()
    assert stored_steps(folder / "resume") == [270]
    assert resume(folder) == 0
    assert outcome(folder) == whole
    assert not list(folder.glob("states*"))


def test_no_second_process_writes_a_run_whose_states_were_removed(tmp_path, at_step, capsys):
    folder, errors = tmp_path / "tdc" / "Hopper-v4_1", []

    def remove_then_resume():
        shutil.rmtree(folder / "resume")
        command = [sys.executable, str(ROOT / "train.py"), "--resume", str(folder), "--start-over"]
        errors.append(subprocess.run(command, capture_output=True, text=True, check=False))

    at_step(270, remove_then_resume)
    assert run_train(tmp_path) == 0
    assert errors[0].returncode == 2
    assert "Another process, or a newer ResumeCallback in this process, writes to" in errors[0].stderr


def test_a_run_whose_lock_another_process_has_taken_stops_with_a_sentence(tmp_path, at_step, capsys):
    folder, others = tmp_path / "tdc" / "Hopper-v4_1", []

    def take_over():
        (folder / "resume.lock").unlink()
        others.append(ResumeCallback(folder / "resume"))

    at_step(270, take_over)
    assert run_train(tmp_path) == 1
    others[0].store.close()
    error = capsys.readouterr().err
    assert "Another process, or a newer ResumeCallback in this process, writes to" in error
    assert "Traceback" not in error


def test_an_edited_config_is_named_and_can_be_changed_openly(stopped, capsys):
    path = stopped / "Hopper-v4" / "config.yml"
    config = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump({**config, "gamma": 0.9}))
    error = fails(lambda: resume(stopped), capsys)
    assert "gamma was 0.99 when" in error
    assert "and is 0.9 now: put it back, or change it by -params gamma:" in error
    path.write_text(yaml.safe_dump(config))
    assert resume(stopped, "-params", "gamma:0.9") == 0
    assert TDC.load(stopped / "Hopper-v4.zip", device="cpu").gamma == 0.9
    assert yaml.safe_load(path.read_text())["gamma"] == 0.9


@pytest.mark.parametrize(("normalize", "expected"), [("true", 0.9), ("{gamma: 0.95}", 0.95)])
def test_a_changed_gamma_is_that_of_normalized_rewards_unless_they_have_their_own(
    tmp_path, stop_at, monkeypatch, normalize, expected
):
    of_td3 = [*SMALL_ANY, f"normalize:{normalize}"]
    stop_at(130)
    assert run_train(tmp_path, "--algo", "td3", "-tb", "", env="Pendulum-v1", n=150, small=of_td3) == 130
    monkeypatch.undo()
    folder = tmp_path / "td3" / "Pendulum-v1_1"
    assert resume(folder, "-params", "gamma:0.9") == 0
    env = DummyVecEnv([lambda: gym.make("Pendulum-v1")])
    assert load_normalization(folder / "Pendulum-v1" / "vecnormalize.pkl", env).gamma == expected


def test_a_run_with_changed_hyperparameters_is_resumed_again(stopped, monkeypatch):
    original = ProgressCallback._on_step

    def on_step(self):
        if self.num_timesteps == 330:
            os.kill(os.getpid(), signal.SIGTERM)
        return original(self)

    with monkeypatch.context() as patch:
        patch.setattr(ProgressCallback, "_on_step", on_step)
        assert resume(stopped, "-params", "gamma:0.9") == 130
    assert resume(stopped) == 0


def test_a_clock_that_was_set_back_does_not_fold_the_curve(tmp_path, stop_at, monkeypatch, whole):
    clock = time.time
    with monkeypatch.context() as patch:
        patch.setattr(time, "time", lambda: clock() + 86_400)
        stop_at(270)
        assert run_train(tmp_path) == 130
    monkeypatch.undo()
    folder = tmp_path / "tdc" / "Hopper-v4_1"
    assert resume(folder) == 0
    assert outcome(folder) == whole


# ---------------------------------------------------------------- environments that fail


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("raise", "Training failed at step 249: step() raised ZeroDivisionError: in the simulator ("),
        ("shape", "Training failed at step 249: the observation of step() must be numbers of shape (3,)"),
        ("type", "Training failed at step 249: the observation of step() must be numbers of shape (3,)"),
        ("none", "Training failed at step 249: step() raised TypeError: "),
        (
            "no observation",
            "step 249: the observation of step() must be numbers of shape (3,), got None",
        ),
        ("no reward", "Training failed at step 249: the reward of step() must be a number, got None"),
        ("four", "Training failed at step 249: step() raised ValueError: not enough values to unpack"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_an_environment_that_fails_is_one_sentence_and_the_run_can_be_resumed(tmp_path, how, reason, capsys):
    kwargs = ["--env-kwargs", f"how:{how}", "--eval-freq", -1]
    assert run_train(tmp_path, *kwargs, env="Raises-v0") == 1
    error = capsys.readouterr().err
    folder = tmp_path / "tdc" / "Raises-v0_1"
    assert reason in error
    assert "Traceback" not in error
    assert f"train --resume {folder}" in error
    assert not (folder / "Raises-v0.zip").exists()
    if "Training failed" in error:
        assert f"The traceback is in {folder / 'Raises-v0' / 'error.txt'}" in error
        assert "Traceback" in (folder / "Raises-v0" / "error.txt").read_text()
    assert stored_steps(folder / "resume")[0] == 240
    assert resume(folder, "--verbose", 0) == 1  # it fails again, ten steps later


@pytest.mark.parametrize(
    ("how", "arguments", "reason"),
    [
        ("raise", "--eval-freq -1", "step 118: step() raised ZeroDivisionError: in the simulator ("),
        ("killed", "--eval-freq -1", "step 118: the process of environment 0 was ended by SIGKILL"),
        ("die", "--eval-freq 50", "step 50: the process of environment 0 ended with exit status 3"),  # in an evaluation
    ],
)
def test_a_process_of_an_environment_that_fails_is_named(tmp_path, how, arguments, reason):
    options = f"-n 400 --resume-freq 40 --env-kwargs how:{how} at:60 {arguments}".split()
    ended = train_in_process("Raises-v0", "-f", tmp_path, *options, "-params", "n_envs:2", "learning_starts:1000")
    assert ended.returncode == 1
    assert f"Training failed at {reason}" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert "--resume" in ended.stderr


def test_an_environment_that_fails_before_the_first_step_leaves_nothing(tmp_path, capsys):
    error = fails(lambda: run_train(tmp_path, "--env-kwargs", "how:reset", env="Raises-v0"), capsys)
    assert "no scene to load" in error
    assert list(tmp_path.iterdir()) == []
