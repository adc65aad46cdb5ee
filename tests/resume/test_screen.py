"""What a run prints, and the warnings about values that it cannot restore."""

import threading
import warnings

import gymnasium as gym
import pytest
from gymnasium.envs.classic_control import PendulumEnv

from sb3_tdc import TDC, ResumeCallback
from sb3_tdc.cli import train
from sb3_tdc.runs.callbacks.stopping import StopOnSignalCallback

OPTIONS = ["--env", "Pendulum-v1", "-n", "120", "--eval-freq", "40", "--eval-episodes", "1", "--seed", "1"]
SMALL = ["-params", "policy_kwargs:{net_arch: [8]}", "learning_starts:20", "batch_size:16", "buffer_size:1000"]


def train_in(folder, *args):
    return train.main([*OPTIONS, "--device", "cpu", "-f", str(folder), *map(str, args), *SMALL])


def stop_at(monkeypatch, call):
    def _on_step(self):
        self.requested = self.n_calls == call
        return not self.requested

    monkeypatch.setattr(StopOnSignalCallback, "_on_step", _on_step)


def rows(folder):
    lines = (folder / "tdc" / "Pendulum-v1_1" / "progress.csv").read_text().splitlines()
    header, *rows = [line.split(",") for line in lines]
    return [{name: value for name, value in zip(header, row, strict=True) if "time/" not in name} for row in rows]


@pytest.mark.parametrize(("first", "second"), [(1, 2), (2, 1), (2, 2)])
def test_tables_on_the_screen_are_no_part_of_the_state(tmp_path, monkeypatch, capsys, first, second):
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        warnings.filterwarnings("error", "Tried to write empty key-value dict")
        assert train_in(tmp_path / "whole") == 0
        with monkeypatch.context() as patch:
            stop_at(patch, 60)
            assert train_in(tmp_path / "stopped", "--verbose", first) == 130
        capsys.readouterr()
        run = tmp_path / "stopped" / "tdc" / "Pendulum-v1_1"
        assert train.main(["--resume", str(run), "--verbose", str(second)]) == 0
    assert rows(tmp_path / "stopped") == rows(tmp_path / "whole")
    assert ("|    mean_reward " in capsys.readouterr().out) == (second == 2)


def test_the_tables_of_sb3_need_no_warning(tmp_path):
    """The tables that SB3 prints with ``verbose=1``."""
    model = TDC("MlpPolicy", "Pendulum-v1", verbose=1, buffer_size=100, policy_kwargs={"net_arch": [8]}, device="cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        model.learn(20, callback=ResumeCallback(tmp_path, freq=10))


class Locks(PendulumEnv):
    """An environment that holds a lock, which Python cannot see into."""

    def __init__(self, render_mode=None):
        super().__init__(render_mode)
        self.lock = threading.Lock()


gym.register("Locks-v0", Locks, max_episode_steps=30)


def said(caught):
    return [str(each.message) for each in caught if each.category is RuntimeWarning]


def test_one_cause_is_one_sentence(tmp_path, monkeypatch):
    """Also where the cause is in every environment, of training and of evaluation."""
    cause = "env[1].env.env.env.env.lock is a _thread.lock"
    left_out = f"Not in the resume states: env, environment 0 (and 3 others): {cause}"
    with monkeypatch.context() as patch:
        stop_at(patch, 20)
        with pytest.warns(RuntimeWarning) as first:
            train_in(tmp_path, "--env", "Locks-v0", "--resume-freq", "30", "-params", "n_envs:3")
    assert said(first) == [left_out]
    with pytest.warns(RuntimeWarning) as second:
        assert train.main(["--resume", str(tmp_path / "tdc" / "Locks-v0_1")]) == 0
    new_episodes = "Continuing with new episodes, since not all of an environment could be restored: env, environment 0"
    assert said(second) == [left_out, f"{new_episodes}: {cause}"]
