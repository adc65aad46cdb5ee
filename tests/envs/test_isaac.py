"""Isaac Lab's tasks, with a stand-in for each interface of its wrapper."""

import sys

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.monitor import Monitor

from sb3_tdc import TDC
from sb3_tdc.cli import enjoy
from sb3_tdc.cli.train import main
from sb3_tdc.envs import isaac
from sb3_tdc.envs.registry import require_env
from sb3_tdc.resume import ResumeCallback
from tests.helpers.isaac import INTERFACES, LIMIT, TASK, install

N_ENVS = 6


@pytest.fixture(params=INTERFACES)
def interface(request, monkeypatch):
    install(monkeypatch, request.param)
    yield request.param
    gym.registry.pop(TASK, None)


@pytest.fixture
def envs(interface):
    require_env(TASK)
    made = isaac.make_vec(TASK, N_ENVS, seed=1, env_kwargs={"device": "cpu"})
    yield made
    made.close()


def test_actions_without_bounds_are_normalised(envs):
    assert (envs.action_space.low == -1).all()
    assert (envs.action_space.high == 1).all()
    model = TDC("MlpPolicy", envs, learning_starts=1000, seed=0)
    model.learn(20 * N_ENVS)
    assert 0.5 < envs.unwrapped.largest_action <= 1  # the largest random action that the simulator received


def test_bounds_of_the_task_stay(interface, monkeypatch):
    require_env(TASK)
    bounded = gym.spaces.Box(-2.0, 3.0, (2,), np.float32)
    task = gym.registry[TASK].entry_point
    monkeypatch.setattr(task, "single_action_space", property(lambda self: bounded, lambda self, value: None), False)
    wrapper = sys.modules["isaaclab_rl.sb3"].Sb3VecEnvWrapper
    monkeypatch.setattr(wrapper, "_begin", _with_the_space_of_the_task(wrapper._begin))
    assert isaac.make_vec(TASK, N_ENVS, seed=1, env_kwargs={"device": "cpu"}).action_space == bounded


def _with_the_space_of_the_task(begin):
    return lambda self, env, action_space: begin(self, env, env.unwrapped.single_action_space)


def test_last_observations_and_time_outs(envs, interface, recwarn):
    """The points do not move: the last observation is the first, and the next episode starts elsewhere."""
    before = envs.reset().copy()
    for _ in range(LIMIT):
        observations, _, dones, infos = envs.step(np.zeros((N_ENVS, 2), np.float32))
    assert dones.all()
    assert not np.array_equal(observations, before)
    warned = [str(each.message) for each in recwarn if "compute_final_obs" in str(each.message)]
    if interface == "fast_variant":  # returns the observation after the reset: no bootstrapping
        assert not any(info["TimeLimit.truncated"] for info in infos)
        assert len(warned) == 1
    else:
        assert all(info["TimeLimit.truncated"] for info in infos)
        assert np.array_equal([info["terminal_observation"] for info in infos], before)
        assert warned == []


def test_what_the_wrapper_of_isaac_lab_does_not_do(envs):
    assert envs.env_is_wrapped(Monitor) == [False] * N_ENVS
    assert envs.env_is_wrapped(Monitor, [0, 2]) == [False, False]
    with pytest.raises(NotImplementedError, match=r"cannot set attributes of its environments \(gravity\)"):
        envs.set_attr("gravity", 0)
    assert envs.render().shape == (8, 8, 3)


def test_settings_of_the_task(interface):
    require_env(TASK)
    envs = isaac.make_vec(TASK, 2, seed=1, env_kwargs={"device": "cpu", "sim.dt": 0.5})
    assert envs.unwrapped.cfg.sim.dt == 0.5
    with pytest.raises(ValueError, match=r"the configuration of Isaac-Reach-Stand-In-v0 has no sim\.gravity"):
        isaac.make_vec(TASK, 2, seed=1, env_kwargs={"device": "cpu", "sim.gravity": 0})


def test_train(monkeypatch, tmp_path, capsys):
    launched = install(monkeypatch, "action_bounds")
    given = ["sb3-tdc", "--seed", "1"]
    monkeypatch.setattr(sys, "argv", given)
    params = ["n_envs:2000", "learning_starts:4000", "buffer_size:20000", "gradient_steps:2", "batch_size:64"]
    arguments = [
        "--env",
        TASK,
        "-f",
        str(tmp_path),
        "--env-kwargs",
        "device:'cpu'",
        "--no-progress",
        "-params",
        *params,
    ]
    assert main([*arguments, "-n", "40000"]) == 0
    assert launched == [({"headless": True}, ["sb3-tdc"])]  # before the tasks are imported, and without our arguments
    assert sys.argv == given
    screen = capsys.readouterr().out
    assert "allows one simulation a process: no evaluations" in screen
    run = tmp_path / "tdc" / f"{TASK}_1"
    assert (run / f"{TASK}.zip").is_file()
    assert len((run / "0.monitor.csv").read_text().splitlines()) > 2000
    gym.registry.pop(TASK, None)


REGISTER = """
import gymnasium as gym
gym.register("Isaac-Mine-v0", "tests.helpers.isaac:ReachTask", disable_env_checker=True, order_enforce=False)
"""


@pytest.mark.parametrize("imports", ["", "import isaaclab_tasks"])
def test_a_custom_task_is_imported_after_the_application_has_started_once(monkeypatch, tmp_path, imports, capsys):
    launched = install(monkeypatch, "action_bounds")
    (tmp_path / "my_tasks.py").write_text(imports + REGISTER)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "my_tasks", raising=False)
    flags = ["--env", "Isaac-Mine-v0", "--gym-packages", "my_tasks", "-f", str(tmp_path)]
    try:
        assert main([*flags, "-n", "40", "--verbose", "0", "-params", "n_envs:2"]) == 0
        assert enjoy.main([*flags, "--n-episodes", "1", "--no-render"]) == 0
    finally:
        gym.registry.pop("Isaac-Mine-v0", None)
        gym.registry.pop(TASK, None)
    assert "mean ± std of 1 episode" in capsys.readouterr().out
    assert len(launched) == 1


def test_a_resumed_run_begins_new_episodes(monkeypatch, tmp_path):
    """Everything else continues; the stored parts of the interrupted episodes end as if by a time limit."""
    install(monkeypatch, "action_bounds")
    require_env(TASK)

    def learn(n):
        envs = isaac.make_vec(TASK, N_ENVS, seed=1, env_kwargs={"device": "cpu"})
        model = TDC("MlpPolicy", envs, learning_starts=12, buffer_size=600, seed=0)
        states = ResumeCallback(tmp_path, freq=2 * N_ENVS)
        states.select(model)
        model.learn(n, callback=states)
        states.store.close()
        return model

    with pytest.warns(RuntimeWarning, match=r"env\.venv is a .*, which uses isaaclab_rl"):
        learn(7 * N_ENVS)
    with pytest.warns(RuntimeWarning, match="Continuing with new episodes"):
        resumed = learn(10 * N_ENVS)
    assert resumed.num_timesteps == 10 * N_ENVS
    assert resumed.replay_buffer.pos == 10
    assert resumed.replay_buffer.timeouts[:7].any(axis=1).nonzero()[0].tolist() == [4, 5]  # the limit; the interruption
    gym.registry.pop(TASK, None)


def test_refused(monkeypatch, tmp_path, capsys):
    install(monkeypatch, "action_bounds")
    arguments = ["--env", TASK, "-f", str(tmp_path), "--env-kwargs", "device:'cpu'", "-n", "100"]
    with pytest.raises(SystemExit):
        main([*arguments, "--vec-env", "subproc"])
    assert "steps all environments in one simulation: leave out --vec-env subproc" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*arguments, "--algo", "advb_td3"])
    assert "allows one simulation a process: none for the board's test episodes" in capsys.readouterr().err
    gym.registry.pop(TASK, None)


def test_not_installed(capsys, tmp_path):
    with pytest.raises(SystemExit):
        main(["--env", "Isaac-Franka-Cabinet-Direct-v0", "-f", str(tmp_path)])
    assert "Isaac Lab's environments need Isaac Lab and Isaac Sim (isaaclab_tasks)" in capsys.readouterr().err
