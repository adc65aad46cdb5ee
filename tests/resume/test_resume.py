"""``train.py --resume`` and ``ResumeCallback``: what a user sees when a run is stopped, damaged, or changed."""

import contextlib
import errno
import functools
import hashlib
import json
import os
import pickle
import random
import re
import shutil
import signal
import threading
import time
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch as th
import yaml
from gymnasium.envs.classic_control import PendulumEnv
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_tdc import TDC
from sb3_tdc.cli import train
from sb3_tdc.common import plain_yaml
from sb3_tdc.resume import LockedError, NotRestoredError, Restorable, ResumeCallback, callback, stored_steps
from sb3_tdc.resume import run_state as state
from sb3_tdc.runs import training
from sb3_tdc.runs.callbacks import busy_machine
from sb3_tdc.runs.callbacks import stopping as interruption
from sb3_tdc.runs.callbacks.progress import ProgressCallback
from sb3_tdc.runs.folder import RunFolder
from tests.helpers.command_line import SMALL_ANY, run_enjoy
from tests.helpers.training import SMALL, fails, outcome, resume, run_train
from tests.tools import kill
from tests.tools.runs import Stop, StopAt


def test_a_signal_loses_nothing(tmp_path, stop_at, monkeypatch, whole, capsys):
    stop_at(270)
    assert run_train(tmp_path) == 130
    monkeypatch.undo()
    stopped = tmp_path / "tdc" / "Hopper-v4_1"
    screen = capsys.readouterr().out
    assert "Stopped at step 271 of 400." in screen  # the step after the signal; the resumed run repeats it
    assert "To continue from step 270:" in screen
    assert f"sb3-tdc train --resume {stopped}" in screen
    assert resume(stopped) == 0
    screen = capsys.readouterr().out
    assert "Resuming tdc on Hopper-v4, seed 1" in screen
    assert "Continuing from step 270" in screen
    assert outcome(stopped) == whole
    assert not (stopped / "resume").exists()  # no longer needed


def test_a_run_on_a_busy_machine_goes_on_with_another_number_of_threads(tmp_path, monkeypatch, whole):
    """
    A run is stopped when it says that one thread is faster, and continues with one.

    The number of threads is only recorded, not set: a real change could alter the results.
    """
    threads, messages = [2], []

    def say(progress, text):
        messages.append(text)
        if len(messages) == 1:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(th, "get_num_threads", lambda: threads[-1])
    monkeypatch.setattr(th, "set_num_threads", threads.append)
    with monkeypatch.context() as busy:
        busy.setattr(busy_machine, "_WINDOW_SECONDS", 0.0)
        busy.setattr(busy_machine, "_SHARE", float("inf"))
        busy.setattr(busy_machine, "_WASTE", 0.0)
        busy.setattr(ProgressCallback, "say", say)
        assert run_train(tmp_path, "--num-threads", "2") == 130
        stopped = tmp_path / "tdc" / "Hopper-v4_1"
        shutil.copytree(stopped, tmp_path / "copy")
        assert resume(tmp_path / "copy") == 0
        assert len(messages) == 2  # a process does not know what the previous one has said
    time.sleep(1)  # TensorBoard sorts the files of one process and one second by name: 10 before 8
    with pytest.warns(RuntimeWarning, match="threads of torch was 2, is 1"):
        assert resume(stopped, "--num-threads", "1") == 0
    assert outcome(stopped) == whole


def test_a_finished_run_is_left_alone(tmp_path, capsys):
    assert run_train(tmp_path, n=150) == 0
    folder = tmp_path / "tdc" / "Hopper-v4_1"
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    capsys.readouterr()
    assert resume(folder) == 0
    assert capsys.readouterr().out == f"{folder} is finished: there is nothing to resume\n"
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


def test_a_finished_run_starts_over(tmp_path, monkeypatch):
    assert run_train(tmp_path, n=150) == 0
    folder = tmp_path / "tdc" / "Hopper-v4_1"
    first, mark, before = outcome(folder), folder / "Hopper-v4" / "finished.yml", []
    save = training._save
    monkeypatch.setattr(training, "_save", lambda *args: before.append(mark.exists()) or save(*args))
    assert resume(folder, "--start-over") == 0
    assert before == [False]  # a run killed before this counts as unfinished
    assert mark.exists()
    assert outcome(folder) == first


@pytest.mark.parametrize("flags", [["-n", "400"], ["-params", "n_timesteps:400"]], ids=" ".join)
def test_a_run_that_is_made_longer_is_the_run_of_that_length(tmp_path, flags, stop_at, monkeypatch, whole, capsys):
    stop_at(270)
    assert run_train(tmp_path, n=300) == 130
    monkeypatch.undo()
    folder = tmp_path / "tdc" / "Hopper-v4_1"
    stop_at(350)
    assert resume(folder, *flags) == 130
    monkeypatch.undo()
    assert "The run ends at step 400 now, not 300\n" in capsys.readouterr().out
    assert resume(folder) == 0
    assert outcome(folder) == whole
    run = RunFolder.open(folder)
    assert (run.config["n_timesteps"], run.args["n_timesteps"], run.changes) == (400, 400, [])
    capsys.readouterr()
    assert resume(folder) == 0
    assert capsys.readouterr().out == f"{folder} is finished: there is nothing to resume\n"


def test_a_run_is_made_shorter(stopped):
    assert resume(stopped, "-n", "300") == 0
    run = RunFolder.open(stopped)
    assert (run.steps_at_end, run.config["n_timesteps"]) == (300, 300)


def test_schedules_follow_the_new_length(stopped, capsys):
    config = stopped / "Hopper-v4" / "config.yml"
    config.write_text(plain_yaml.dump({**RunFolder.open(stopped).config, "n_timesteps": 300}))
    assert resume(stopped, "-n", "320", "-params", "lam:lin_0.5") == 0
    screen = capsys.readouterr().out
    assert "The run ends at step 320 now, not 300; schedules (lam) follow the new total" in screen
    last = pd.read_csv(stopped / "progress.csv").iloc[-1]
    assert last["train/lam"] == pytest.approx(0.5 * (1 - last["time/total_timesteps"] / 320), abs=0.002)
    changes = [{"step": 270, "hyperparams": {"lam": "lin_0.5", "n_timesteps": 320}}]
    assert RunFolder.open(stopped).changes == changes


def test_a_run_of_rl_zoo_has_the_length_of_its_flag(tmp_path, capsys):
    """RL Zoo keeps ``-n`` out of its hyperparameters."""
    assert run_train(tmp_path, n=150) == 0
    run = RunFolder.open(tmp_path / "tdc" / "Hopper-v4_1")
    folder = run.path / "Hopper-v4"
    config = {**run.config, "n_timesteps": 20_000}
    args = {name: value for name, value in run.args.items() if name != "resume_freq"}
    (folder / "config.yml").write_text(plain_yaml.dump(config))
    (folder / "args.yml").write_text(plain_yaml.dump({**args, "n_timesteps": 150}))
    capsys.readouterr()
    assert resume(run.path, "-n", "150") == 0
    assert "is finished: there is nothing to resume" in capsys.readouterr().out
    assert "with -i" in fails(lambda: resume(run.path, "-n", "20000"), capsys)
    assert resume(run.path, "--start-over") == 0
    assert RunFolder.open(run.path).steps_at_end == 150


@pytest.mark.parametrize("edited", ["many", None, 1.5, [3]])
def test_a_length_that_is_no_number_is_named(stopped, edited, capsys):
    config = stopped / "Hopper-v4" / "config.yml"
    config.write_text(plain_yaml.dump({**RunFolder.open(stopped).config, "n_timesteps": edited}))
    error = fails(lambda: resume(stopped), capsys)
    assert f"{config}: n_timesteps" in error
    assert "Traceback" not in error


def test_a_run_that_starts_over_with_other_hyperparameters_is_one_of_these(stopped):
    assert resume(stopped, "-n", "280", "-params", "lam:0.25") == 0
    assert RunFolder.open(stopped).changes == [{"step": 270, "hyperparams": {"lam": 0.25}}]
    assert resume(stopped, "--start-over", "-params", "tau:0.01") == 0
    run = RunFolder.open(stopped)
    assert (run.changes, run.config["lam"], run.config["tau"]) == ([], 0.25, 0.01)


def test_a_finished_run_cannot_be_made_longer(tmp_path, capsys):
    assert run_train(tmp_path, n=150) == 0
    folder = tmp_path / "tdc" / "Hopper-v4_1"
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    error = fails(lambda: resume(folder, "-n", "200"), capsys)
    assert "is finished, at step 150, and a finished run has no resume states: train its model further" in error
    assert f"-i {folder / 'Hopper-v4.zip'} -n 50" in error
    assert "n_timesteps 120 adds none" in fails(lambda: resume(folder, "-params", "n_timesteps:120"), capsys)
    assert resume(folder, "-n", "150") == 0
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
    assert resume(folder, "--start-over", "-n", "160") == 0
    assert RunFolder.open(folder).steps_at_end == 160


def test_a_registered_function_need_not_be_sent_from_its_process(tmp_path, recwarn):
    gym.register("OfAFunction-v0", lambda **kwargs: PendulumEnv(**kwargs), max_episode_steps=50)
    spec = pickle.loads(pickle.dumps(Restorable(gym.make("OfAFunction-v0", max_episode_steps=20)).spec))
    assert (spec.id, spec.max_episode_steps) == ("OfAFunction-v0", 20)
    assert run_train(tmp_path, "--vec-env", "subproc", "-params", *SMALL[1:], "n_envs:2", env="OfAFunction-v0") == 0
    with np.load(tmp_path / "tdc" / "OfAFunction-v0_1" / "evaluations.npz") as evaluations:
        assert (evaluations["ep_lengths"] == 50).all()
    assert not [warned for warned in recwarn if "OfAFunction" in str(warned.message) or "spec" in str(warned.message)]


def test_a_run_that_normalizes_only_rewards_is_trained_resumed_and_played(tmp_path, stop_at, monkeypatch):
    """VecNormalize has no statistics of observations then."""
    of_td3 = [*SMALL_ANY, "normalize:{norm_obs: false}"]
    stop_at(130)
    assert run_train(tmp_path, "--algo", "td3", "-tb", "", env="Pendulum-v1", n=150, small=of_td3) == 130
    monkeypatch.undo()
    assert resume(tmp_path / "td3" / "Pendulum-v1_1") == 0
    assert run_enjoy("--algo", "td3", "--env", "Pendulum-v1", "-f", tmp_path) == 0


def test_starting_over_needs_consent(stopped, whole, capsys):
    shutil.rmtree(stopped / "resume")
    before = {path: path.read_bytes() for path in stopped.rglob("*") if path.is_file()}
    assert "--start-over begins at step 0 again" in fails(lambda: resume(stopped), capsys)
    assert {path: path.read_bytes() for path in stopped.rglob("*") if path.is_file()} == before
    assert resume(stopped, "--start-over") == 0
    assert outcome(stopped) == whole


def test_starting_over_removes_states_that_are_there(stopped, whole, capsys):
    assert resume(stopped, "--start-over") == 0
    assert "Continuing from" not in capsys.readouterr().out
    assert outcome(stopped) == whole


def test_a_run_that_was_stopped_before_its_first_step_begins_again(tmp_path, whole, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(ResumeCallback, "_write", lambda *args: os.kill(os.getpid(), signal.SIGKILL))
        if (child := os.fork()) == 0:
            run_train(tmp_path)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    assert resume(tmp_path / "tdc" / "Hopper-v4_1") == 0
    assert outcome(tmp_path / "tdc" / "Hopper-v4_1") == whole


def test_a_damaged_state_costs_only_the_way_from_the_one_before(stopped, whole):
    newest = max((stopped / "resume").glob("step_*"))
    (newest / "weights.pt").write_bytes((newest / "weights.pt").read_bytes()[:-1])
    with pytest.warns(RuntimeWarning, match=r"weights.pt is damaged; going back to the state of step 269"):
        assert resume(stopped) == 0
    assert outcome(stopped) == whole


def test_what_cannot_be_resumed_gets_one_sentence(stopped, tmp_path, capsys):
    for args, message in (
        (["--seed", "3"], f"--seed 3 contradicts the run in {stopped}: --seed 1"),
        (["--algo", "sac"], "--algo sac contradicts the run in"),
        (["-n", "270"], "n_timesteps must be above 270, the step of the resume state, got 270"),
        (["-params", "n_timesteps:many"], "n_timesteps must be an integer, got 'many'"),
        (["-i", "other.zip"], "other.zip contradicts the run in"),
        (["--preset", "parallel"], "--preset parallel contradicts the run in"),
        (["-params", "buffer_size:5"], "buffer_size cannot be changed when a run is resumed; learning_rate, "),
        (["-params", "lamb:0.5"], "command line (-params): unknown key 'lamb'; did you mean 'lam'?"),
        (["--from", "100"], "has no state of step 100; there are: 270, 269, "),
    ):
        assert message in fails(lambda args=args: resume(stopped, *args), capsys)
    assert "is not the folder of a run" in fails(lambda: resume(tmp_path), capsys)
    for manifest in (stopped / "resume").glob("*/manifest"):
        manifest.unlink()
    assert "No state in" in fails(lambda: resume(stopped), capsys)
    assert len(list((stopped / "resume").glob("step_*"))) == 4  # nothing was thrown away
    args = yaml.safe_load((stopped / "Hopper-v4" / "args.yml").read_text())
    (stopped / "Hopper-v4" / "args.yml").write_text(yaml.safe_dump({**args, "resume_freq": -1}))
    assert "has no resume states" in fails(lambda: resume(stopped), capsys)
    (stopped / "Hopper-v4" / "args.yml").unlink()
    assert "was stopped before its run began" in fails(lambda: resume(stopped), capsys)


def test_a_run_is_resumed_by_the_arguments_that_began_it(tmp_path, monkeypatch, capsys):
    (tmp_path / "pendulums.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    began = ["--env", "pendulums:Pendulum-v1", "--gym-packages", "os", "-n", "120", "-f", str(tmp_path), "--seed", "-1"]
    assert train.main([*began, "--device", "cpu", "--eval-freq", "-1", *SMALL]) == 0
    run = tmp_path / "tdc" / "Pendulum-v1_1"
    capsys.readouterr()
    assert resume(run, *began) == 0
    assert "is finished: there is nothing to resume" in capsys.readouterr().out
    assert "--gym-packages ['math'] contradicts" in fails(lambda: resume(run, "--env", "math:Pendulum-v1"), capsys)


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_what_is_refused_changes_nothing(stopped, capsys):
    broken = ["n_envs:2", "callback:{stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes: {colour: red}}"]
    before = contents(stopped)
    for args, message in (
        (["--from", "1"], "has no state of step 1; there are: 270, 269, "),
        (["-n", "270"], "n_timesteps must be above 270"),
        (["-params", "buffer_size:5"], "buffer_size cannot be changed when a run is resumed"),
        (["--start-over", "--from", "269"], "--start-over begins at step 0, not at the state of --from 269: use one"),
        (["--start-over", "-params", *broken], "unexpected keyword argument 'colour'"),
    ):
        assert message in fails(lambda args=args: resume(stopped, *args), capsys)
        assert contents(stopped) == before, args
    shutil.rmtree(stopped / "resume")
    (stopped / "resume.lock").unlink()
    RunFolder.open(stopped).mark_finished(270)
    before = contents(stopped)
    assert "'colour'" in fails(lambda: resume(stopped, "--start-over", "-params", *broken), capsys)
    assert contents(stopped) == before
    assert not (stopped / "resume").exists()


def test_any_hyperparameter_may_change_when_a_run_starts_over(stopped):
    (stopped / "1.monitor.csv").write_text("of a second environment\n")
    assert resume(stopped, "--start-over", "-n", 120, "-params", "buffer_size:200") == 0
    assert TDC.load(stopped / "Hopper-v4.zip", device="cpu").buffer_size == 200
    assert not (stopped / "1.monitor.csv").exists()


def test_nothing_of_the_former_training_stays_when_a_run_starts_over(tmp_path):
    assert run_train(tmp_path, "--save-freq", 100, "--save-replay-buffer", small=[*SMALL, "normalize:true"], n=160) == 0
    folder = tmp_path / "tdc" / "Hopper-v4_1"
    run = RunFolder.open(folder)
    run.write_error("of the former training")
    run.test_returns.write_bytes(b"of the former model")
    (folder / "notes.txt").write_text("mine")
    assert resume(folder, "--start-over", "-n", 60) == 0  # too short for an evaluation and a saved model
    logs = {"progress.csv", "0.monitor.csv", "events.out.tfevents"}
    records = {"args.yml", "command.txt", "config.yml", "versions.yml", "finished.yml"}
    models = {"Hopper-v4.zip", "replay_buffer.pkl", "vecnormalize.pkl"}
    left = sorted(path.name for path in folder.rglob("*") if path.is_file())
    assert [name.partition(".tfevents.")[0] + ".tfevents" if "tfevents" in name else name for name in left] == sorted(
        {*logs, *records, *models, "notes.txt"}
    )


def test_models_of_later_steps_go_when_a_run_goes_back(tmp_path, stop_at, monkeypatch):
    stop_at(270)
    assert run_train(tmp_path, "--save-freq", 30) == 130
    monkeypatch.undo()
    run = RunFolder.open(tmp_path / "tdc" / "Hopper-v4_1")
    run.test_returns.write_bytes(b"of the model of step 271")

    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "_learn", interrupted)
    assert resume(run.path) == 130
    assert list(run.checkpoints()) == [*range(30, 271, 30)]
    assert run.model.exists()
    assert resume(run.path, "--from", 40, "-params", "gamma:0.9") == 130
    assert list(run.checkpoints()) == [30]
    assert not run.model.exists()
    assert not run.test_returns.exists()


def test_the_same_arguments_are_no_contradiction(stopped, whole):
    assert resume(stopped, "--env", "Hopper-v4", "--seed", "1", "--verbose", "0") == 0
    assert outcome(stopped) == whole


def test_a_full_disk_stops_nothing_but_the_state(tmp_path, whole, monkeypatch, stop_at):
    """From step 100 to 250 nothing can be synced: no state is written, and the previous one stays."""
    folder = tmp_path / "tdc" / "Hopper-v4_1"
    write = ResumeCallback._write

    def full(self, step):
        with monkeypatch.context() as patch:
            if 100 <= step <= 250:
                patch.setattr(os, "fsync", no_space)
            write(self, step)

    def no_space(descriptor):
        assert list((folder / "resume").glob("step_*"))
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(ResumeCallback, "_write", full)
    stop_at(300)
    with pytest.warns(
        RuntimeWarning, match=r"could not be written .*No space left.* Training continues; that of step 80"
    ):
        assert run_train(tmp_path) == 130
    monkeypatch.undo()
    assert resume(folder) == 0
    assert outcome(folder) == whole


def test_a_full_disk_does_not_stop_an_evaluation(tmp_path, monkeypatch):
    def full(self, path, *args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    save = TDC.save
    monkeypatch.setattr(TDC, "save", lambda self, path: (full if "best" in str(path) else save)(self, path))
    with pytest.warns(UserWarning, match=r"best model of step 150 was not saved.*No space left"):
        assert run_train(tmp_path, n=200) == 0


def test_a_signal_does_not_wait_for_the_end_of_an_endless_episode(tmp_path, capsys, monkeypatch, stop_at):
    gym.register("Endless-v1", PendulumEnv)
    monkeypatch.setattr(interruption, "_PATIENCE_SECONDS", 0.3)
    stop_at(200)
    start = time.monotonic()
    episodes = [*SMALL, "train_freq:[1, episode]"]
    assert run_train(tmp_path, "--eval-freq", -1, env="Endless-v1", n=1_000_000, small=episodes) == 130
    assert time.monotonic() - start < 60
    assert "To continue from step 0:" in capsys.readouterr().out


@pytest.mark.slow
def test_several_kills(tmp_path):
    """Fewer kills than ``python -m tests.tools.kill`` makes by default."""
    assert kill.main(["--kills", "3", "--steps", "1500", "--longest", "0.4", "--folder", str(tmp_path)]) == 0


# ---------------------------------------------------------------- in Python


def make_model(env="Pendulum-v1", algorithm=TDC, seed=1, **kwargs):
    defaults = {"learning_starts": 20, "batch_size": 8, "buffer_size": 500, "policy_kwargs": {"net_arch": [8, 8]}}
    policy = "MultiInputPolicy" if kwargs.pop("multi_input", False) else "MlpPolicy"
    return algorithm(policy, env, seed=seed, device="cpu", **{**defaults, **kwargs})


def learn(model, folder, stop_at=None, steps=150, **kwargs):
    states = ResumeCallback(folder, freq=20, verbose=0, **kwargs)
    try:
        restored = states.select(model)
        model.learn(steps, callback=[states, StopAt(stop_at)])
    except Stop:
        pass
    finally:
        states.store.close()
    return restored


def test_a_state_of_another_run_is_refused(tmp_path):
    learn(make_model(), tmp_path, stop_at=70)
    for model, difference in (
        (make_model(algorithm=SAC), "the algorithm was sb3_tdc.tdc.tdc.TDC, and is stable_baselines3.sac.sac.SAC"),
        (make_model("MountainCarContinuous-v0"), "the environment was Pendulum-v1, and is MountainCarContinuous-v0"),
        (make_model(policy_kwargs={"net_arch": [4]}), "the network is another"),
        (make_model(buffer_size=400), "the size of the replay buffer was 500, and is 400"),
        (make_model(make_vec_env("Pendulum-v1", 2)), "the number of environments was 1, and is 2"),
    ):
        with pytest.raises(ValueError, match=re.escape(difference)):
            learn(model, tmp_path)
    model, states = make_model(), ResumeCallback(tmp_path)
    with pytest.raises(ValueError, match="has states of a run already: call select"):
        model.learn(10, callback=states)
    states.store.close()


@pytest.mark.parametrize("freq", [20, 10_000])
def test_a_callback_does_not_mix_the_states_of_two_runs(tmp_path, freq):
    """As when the cell of a notebook that calls ``learn`` is run again: SB3 counts from 0, with the trained model."""
    model, states = make_model(), ResumeCallback(tmp_path / "resume", freq=freq, verbose=0)
    model.learn(50, callback=states)
    steps = [40, 20, 0] if freq == 20 else [0]
    assert states.store.steps() == steps
    with pytest.raises(ValueError, match="has states of a run already: call select"):
        model.learn(50, callback=states)
    assert states.store.steps() == steps
    model.num_timesteps = 50  # before the refused call
    model.learn(40, callback=states, reset_num_timesteps=False)
    assert max(states.store.steps()) == (80 if freq == 20 else 0)
    shutil.rmtree(tmp_path / "resume")
    model.learn(50, callback=states)
    assert states.store.steps() == steps
    states.store.close()
    resumed, states = make_model(), ResumeCallback(tmp_path / "resume", verbose=0)
    assert states.select(resumed) == max(steps)
    resumed.learn(50, callback=states)
    states.store.close()
    np.testing.assert_array_equal(resumed.replay_buffer.observations, model.replay_buffer.observations)


def test_an_older_callback_removes_nothing_of_a_newer_one(tmp_path):
    learn(make_model(), tmp_path, stop_at=70)
    steps = stored_steps(tmp_path)
    assert len(steps) > 1
    model, older = make_model(), ResumeCallback(tmp_path, verbose=0)
    older.select(model, step=steps[-1])
    newer = ResumeCallback(tmp_path, verbose=0)
    with pytest.raises(LockedError):
        model.learn(150, callback=older)
    assert stored_steps(tmp_path) == steps
    newer.store.close()


class Replaces(BaseCallback):
    """Replaces ``ent_coef`` during a run."""

    def __init__(self, ent_coef, step):
        super().__init__()
        self.ent_coef, self.step = ent_coef, step

    def _on_step(self):
        if self.num_timesteps == self.step:
            self.model.ent_coef = self.ent_coef
        return True


def learn_and_replace(folder, built, replaced, at, stop_at=None):
    model = make_model(stochastic_actor=True, ent_coef=built, learning_starts=40)
    states = ResumeCallback(folder, freq=20, verbose=0)
    states.select(model)
    with contextlib.suppress(Stop):
        model.learn(90, callback=[states, Replaces(replaced, at), StopAt(stop_at)])
    states.store.close()
    return model


@pytest.mark.parametrize(
    ("built", "replaced", "at", "stop_at"),
    [
        ("auto", 0.1, 30, 55),  # the state of step 40, before the first update, which builds the new temperature
        ("auto", 0.1, 50, 75),
        (0.1, "auto", 50, 75),
        ("auto", "auto_0.1", 50, 75),
    ],
)
def test_a_replaced_temperature_is_that_of_the_resumed_run(tmp_path, built, replaced, at, stop_at):
    whole = learn_and_replace(tmp_path / "whole", built, replaced, at)
    learn_and_replace(tmp_path / "stopped", built, replaced, at, stop_at)
    resumed = learn_and_replace(tmp_path / "stopped", built, replaced, at)
    assert resumed.ent_coef == whole.ent_coef == replaced
    assert resumed.current_ent_coef().equal(whole.current_ent_coef())
    weights = whole.policy.state_dict()
    assert all(weight.equal(weights[name]) for name, weight in resumed.policy.state_dict().items())


def test_a_state_with_other_optimizers_is_refused(tmp_path):
    """Only TDC builds the temperature of a state: SAC reads ``ent_coef`` once, when it is made."""
    learn(make_model(algorithm=SAC), tmp_path, stop_at=70)
    with pytest.raises(NotRestoredError, match=r"has the weights of .*, ent_coef_optimizer, .* ent_coef_tensor"):
        learn(make_model(algorithm=SAC, ent_coef=0.1), tmp_path)


def test_other_callbacks_are_noticed(tmp_path):
    learn(make_model(), tmp_path, stop_at=70)
    model, states = make_model(), ResumeCallback(tmp_path)
    states.select(model)
    with pytest.raises(ValueError, match="callbacks"):
        model.learn(100, callback=states)
    states.store.close()


def test_another_platform_is_named(tmp_path, monkeypatch):
    learn(make_model(), tmp_path, stop_at=70)
    here = state.describe_platform(make_model())
    monkeypatch.setattr(state, "describe_platform", lambda model: {**here, "torch": "9.9"})
    with pytest.warns(RuntimeWarning, match=f"torch was {re.escape(here['torch'])}, is 9.9$"):
        learn(make_model(), tmp_path)


class Locked(PendulumEnv):
    """An environment that cannot be captured, as Python cannot see into its lock."""

    def __init__(self):
        super().__init__()
        self.lock = threading.Lock()


gym.register("Locked-v0", Locked, max_episode_steps=1000)


@pytest.mark.parametrize(("vec_env", "kwargs"), [(None, {}), (None, {"n_steps": 3}), (SubprocVecEnv, {})], ids=str)
def test_an_environment_that_cannot_be_captured_starts_its_episode_again(tmp_path, vec_env, kwargs):
    def make():
        if vec_env is None:
            return make_model("Locked-v0", **kwargs)
        return make_model(make_vec_env(Locked, 2, vec_env_cls=vec_env, wrapper_class=Restorable), **kwargs)

    learn(make(), tmp_path, stop_at=70)
    model = make()
    seen = {}
    original = callback.ResumeCallback._restore

    def look(self):
        original(self)
        seen.update(pos=model.replay_buffer.pos, updates=model._n_updates)
        seen["last"] = model.replay_buffer.dones[seen["pos"] - 1].copy(), model.replay_buffer.timeouts[seen["pos"] - 1]
        seen["observations"] = model._last_obs.copy()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(callback.ResumeCallback, "_restore", look)
        with pytest.warns(RuntimeWarning, match=r"with new episodes.*lock is a _thread.lock"):
            assert learn(model, tmp_path) == 60
    assert seen["pos"] == 60 // model.n_envs
    assert seen["updates"] > 0
    assert all((part == 1).all() for part in seen["last"])  # cut off there, as by a time limit
    assert model.num_timesteps == 150
    # The random generators continue: this is not the first episode again
    assert not np.isclose(seen["observations"], make().env.reset()).all(axis=-1).any()


def test_processes_without_the_wrapper_are_told_about_it(tmp_path):
    def make():
        return make_model(make_vec_env("Pendulum-v1", 2, vec_env_cls=SubprocVecEnv))

    learn(make(), tmp_path, stop_at=70)
    with pytest.warns(RuntimeWarning, match=r"wrap its environments in sb3_tdc.resume.Restorable"):
        learn(make(), tmp_path)


def cyclic():
    """Return a list that contains itself through a tuple, next to an iterator, which cannot be captured."""
    parts = []
    parts.append((parts, iter(())))
    return parts


def deep(n):
    return functools.reduce(lambda inside, _: [inside], range(n), [])


@pytest.mark.parametrize("what", [threading.Lock(), random.SystemRandom(), cyclic(), deep(5_000)], ids=type)
def test_an_attribute_of_the_algorithm_that_cannot_be_captured_is_left_out_and_named(tmp_path, what):
    model = make_model()
    model.extra = what
    with pytest.warns(RuntimeWarning, match=r"Not in the resume states: model\.extra.* (is a|is nested)"):
        learn(model, tmp_path, stop_at=70)
    model = make_model()
    model.extra = "as built"
    assert learn(model, tmp_path) == 60
    assert model.extra == "as built"
    assert model.num_timesteps == 150


def test_arguments_out_of_range(tmp_path):
    for name in ("freq", "keep"):
        with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
            ResumeCallback(tmp_path, **{name: 0})


def test_nothing_is_pickled(tmp_path):
    """Every file is JSON, arrays without objects, or weights; a pickle put in the place of one is not executed."""
    learn(make_model(), tmp_path, stop_at=70)
    kinds = {path.suffix for path in tmp_path.rglob("*") if path.is_file()} - {""}
    assert kinds == {".json", ".npz", ".pt"}
    for path in tmp_path.rglob("*.npz"):
        with np.load(path, allow_pickle=False) as arrays:
            assert all(arrays[name].dtype != object for name in arrays.files)
    newest = max(tmp_path.glob("step_*"))
    json.loads((newest / "state.json").read_text())
    th.load(newest / "weights.pt", weights_only=True)

    class Poison:
        def __reduce__(self):
            return Path.touch, (tmp_path / "executed",)

    th.save({"state_dicts": Poison()}, newest / "weights.pt")
    np.savez(newest / "arrays.npz", **{"0": np.array([Poison()], dtype=object)})
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        patch.setattr("sb3_tdc.resume.store._sha256", lambda path: _digest_of(newest, path))
        with pytest.raises(Exception, match=r"[Ww]eights|pickle"):
            learn(make_model(), tmp_path)
    assert not (tmp_path / "executed").exists()


def _digest_of(folder, path):
    """Return the SHA-256 that the manifest states, as if it had been forged too."""
    manifest = json.loads((folder / "manifest").read_text().splitlines()[0])
    known = {**manifest["files"], **manifest["shared"]}
    return known.get(path.name, hashlib.sha256(path.read_bytes()).hexdigest())


def test_what_is_written_is_what_was_added(tmp_path):
    """Each state adds bytes in proportion to its new transitions; overwritten parts of the ring are removed."""
    model = make_model(buffer_size=200)
    learn(model, tmp_path, steps=1000)
    segments = sorted((tmp_path / "replay").iterdir())
    sizes = [path.stat().st_size for path in segments]
    assert max(sizes) < 1.1 * min(sizes)
    # A segment holds 20 transitions, so 10 segments hold the ring of 200. Four states stay, with the segments that they
    # need: the two newest, one that is 10 to 20 states older, and the one that will replace it
    assert 20 <= len(segments) <= 32
    assert len(list(tmp_path.glob("step_*"))) == 4
