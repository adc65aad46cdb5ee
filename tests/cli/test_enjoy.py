"""Which model ``enjoy`` plays, and which arguments it refuses."""

import re
import shutil
from contextlib import nullcontext
from typing import ClassVar

import gymnasium as gym
import pytest
from gymnasium.envs.classic_control import PendulumEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tdc.advb import AdvBTD3
from sb3_tdc.cli import enjoy
from sb3_tdc.common.playing import play_episodes
from sb3_tdc.experiments.final_episodes import measure_run
from sb3_tdc.experiments.results import Run
from tests.helpers.command_line import SMALL, SMALL_ANY, run_enjoy, run_train
from tests.helpers.training import fails


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    assert run_train(folder, "--verbose", 0, env="Pendulum-v1", n=210) == 0
    return folder / "tdc" / "Pendulum-v1_1"


@pytest.fixture
def lone(run, tmp_path):
    """A model that was copied out of its run folder."""
    return shutil.copy(run / "Pendulum-v1.zip", tmp_path / "lone.zip")


def refused(capsys, *arguments):
    with pytest.raises(SystemExit) as stopped:
        enjoy.main([*map(str, arguments), "--no-render"])
    assert stopped.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1
    return captured.err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--n-episodes", "0"], "--n-episodes must be at least 1, got 0"),
        (["--n-episodes", "-3"], "--n-episodes must be at least 1, got -3"),
        (["-n", "0"], "-n must be at least 1 (or -1: no limit), got 0"),
        (["-n", "-2"], "-n must be at least 1 (or -1: no limit), got -2"),
        (["--num-threads", "0"], "--num-threads must be at least 1"),
        (["--device", "gpu"], "--device must be one of auto, cpu"),
        (["--algo", "sac"], "--algo sac contradicts {run}: it was trained with tdc"),
        (["--env", "Hopper-v4"], "--env Hopper-v4 contradicts {run}: it was trained with Pendulum-v1"),
        (["--exp-id", "2"], "--exp-id chooses a model, and so does {run}: leave out one"),
        (["-f", "elsewhere"], "--log-folder chooses a model, and so does {run}: leave out one"),
    ],
)
def test_what_contradicts_a_run(run, arguments, sentence, capsys):
    assert sentence.format(run=run) in refused(capsys, run, *arguments)


def test_a_file_of_a_run_is_chosen_once(run, capsys):
    model = run / "Pendulum-v1.zip"
    assert f"--load-best chooses a model, and so does {model}" in refused(capsys, model, "--load-best")
    assert "--env Hopper-v4 contradicts" in refused(capsys, model, "--env", "Hopper-v4")
    assert run_enjoy(model, "--algo", "tdc", "--env", "Pendulum-v1") == 0  # the flags agree with the run


def test_a_file_outside_a_run_says_nothing_of_its_environment(lone, capsys):
    sentence = f"{lone} is not in the folder of a run: say with --env what it was trained on"
    assert sentence in refused(capsys, lone)
    assert run_enjoy(lone, "--env", "Pendulum-v1") == 0
    assert "mean ± std of 2 episodes" in capsys.readouterr().out


def test_a_file_that_is_not_there(tmp_path, capsys):
    assert f"{tmp_path / 'missing.zip'} does not exist" in refused(capsys, tmp_path / "missing.zip")


def test_a_run_folder_after_the_packages_is_no_package(run, capsys):
    assert f"--gym-packages takes names of modules, got '{run}': a run folder goes before this flag" in refused(
        capsys, "--gym-packages", "os", run
    )


class Seeded(PendulumEnv):
    """Takes an argument with the name of one of ours."""

    seeds: ClassVar = []

    def __init__(self, seed=0, render_mode=None):
        super().__init__(render_mode)
        self.seeds.append(seed)


def test_a_constructor_may_take_a_seed(tmp_path):
    gym.register("Seeded-v0", Seeded, max_episode_steps=10)
    assert run_train(tmp_path, "--env-kwargs", "seed:3", "--verbose", 0, env="Seeded-v0", n=120) == 0
    run = tmp_path / "tdc" / "Seeded-v0_1"
    assert run_enjoy(run) == 0
    assert len(measure_run(Run.open(run), episodes=1)) == 1
    assert set(Seeded.seeds) == {3}


def test_one_episode_is_one(run, capsys):
    assert enjoy.main([str(run), "--no-render", "--n-episodes", "1"]) == 0
    assert capsys.readouterr().out.endswith("± 0.00 (mean ± std of 1 episode)\n")


def test_a_board_acts_as_in_predict_unless_it_is_left_out(run, tmp_path, capsys):
    assert run_train(tmp_path, "--verbose", 0, algo="advb_td3", env="Pendulum-v1", n=410, small=SMALL_ANY) == 0
    advised = tmp_path / "advb_td3" / "Pendulum-v1_1"
    model = AdvBTD3.load(advised / "Pendulum-v1.zip")
    assert len(model.policy.board) > 0
    returns = {}
    for flags in ([], ["--actor-alone"]):
        capsys.readouterr()
        assert run_enjoy(advised, *flags) == 0
        (returns["alone" if flags else "board"],) = re.findall(r"Episode   1: return +(\S+),", capsys.readouterr().out)
    env = DummyVecEnv([lambda: Monitor(gym.make("Pendulum-v1"))])
    for who, acting in (("board", nullcontext()), ("alone", model.policy.actor_alone())):
        env.seed(0)
        with acting:
            assert f"{next(play_episodes(model, env)).total:.2f}" == returns[who]
    assert returns["board"] != returns["alone"]
    assert "--actor-alone is for models of advb_td3, advb_sac and advb_tdc" in fails(
        lambda: run_enjoy(run, "--actor-alone"), capsys
    )


def test_the_critics_of_advb_tdc_are_explained_too(tmp_path, capsys):
    assert run_train(tmp_path, "--verbose", 0, algo="advb_tdc", env="Pendulum-v1", n=210, small=SMALL) == 0
    run = tmp_path / "advb_tdc" / "Pendulum-v1_1"
    capsys.readouterr()
    assert enjoy.main([str(run), "--explain", "--n-episodes", "1"]) == 0
    assert (run / "Pendulum-v1_critics.png").stat().st_size > 10_000


class Overheats(PendulumEnv):
    """Fails at its second step."""

    steps = 0

    def step(self, action):
        self.steps += 1
        if self.steps == 2:
            raise RuntimeError("the motor is too hot")
        return super().step(action)


def test_an_environment_that_fails_is_named_in_one_sentence(lone, capsys):
    gym.register("Overheats-v0", Overheats)
    assert run_enjoy(lone, "--env", "Overheats-v0") == 1
    error = capsys.readouterr().err
    assert "error: the environment failed: step() raised RuntimeError: the motor is too hot (" in error
    assert len(error.splitlines()) == 1
