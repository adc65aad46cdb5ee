"""Environments that fail in every way: in this process, in a subprocess, and while they are made."""

import os
import sys
import threading
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor

from sb3_tdc.envs.checked import CheckedEnv, CheckedSubprocVecEnv, EnvironmentFaultError


def raise_(error):
    raise error


class Answers(gym.Env):
    """
    An environment that may return anything.

    :param stepped: returns the answer of ``step``
    :param begun: returns the answer of ``reset``
    """

    observation_space = spaces.Box(-1, 1, (3,))
    action_space = spaces.Box(-1, 1, (1,))

    def __init__(self, stepped=lambda: GOOD, begun=lambda: (np.zeros(3), {}), space=None):
        self.stepped, self.begun = stepped, begun
        self.observation_space = space or self.observation_space

    def reset(self, *, seed=None, options=None):
        return self.begun()

    def step(self, action):
        return self.stepped()

    def compute(self, number):
        return 1 / number


GOOD = (np.zeros(3), 1.0, False, False, {})


def changed(index, value):
    """Return a good answer of ``step`` with one of its five parts replaced."""
    return (*GOOD[:index], value, *GOOD[index + 1 :])


BAD_STEPS = [
    (None, r"step\(\) must return \(observation, reward, .*, got None"),
    (GOOD[:4], "got a tuple of 4"),
    (changed(0, np.zeros(1)), r"numbers of shape \(3,\), got an array of shape \(1,\)"),  # NumPy would broadcast it
    (changed(0, 0.5), r"got an array of shape \(\)"),
    (changed(0, np.zeros((1, 3))), r"got an array of shape \(1, 3\)"),
    (changed(0, None), "observation of step.* got None"),
    (changed(0, ["a", "b", "c"]), "got a list of 3"),
    (changed(0, [[1], [2, 3], []]), "got a list of 3"),
    (changed(0, {"observation": np.zeros(3)}), "got dict"),
    (changed(1, None), r"reward of step\(\) must be a number, got None"),
    (changed(1, "1.0"), "got str '1.0'"),
    (changed(1, np.zeros(2)), r"got an array of shape \(2,\)"),
    (changed(2, None), r"'terminated' of step\(\) must be a bool, got None"),
    (changed(3, "no"), r"'truncated' of step\(\) must be a bool, got str 'no'"),
    (changed(4, None), r"'info' of step\(\) must be a dict, got None"),
]


@pytest.mark.parametrize(("answer", "sentence"), BAD_STEPS)
def test_what_a_step_must_not_return_is_named(answer, sentence):
    env = CheckedEnv(Answers(lambda: answer))
    env.reset()
    with pytest.raises(EnvironmentFaultError, match=sentence):
        env.step(0)


@pytest.mark.parametrize(
    ("answer", "sentence"),
    [
        (np.zeros(3), r"reset\(\) must return \(observation, info\), got an array of shape \(3,\)"),
        ((np.zeros(2), {}), r"observation of reset\(\) must be numbers of shape \(3,\)"),
        ((np.zeros(3), None), r"'info' of reset\(\) must be a dict"),
    ],
)
def test_what_a_reset_must_not_return_is_named(answer, sentence):
    with pytest.raises(EnvironmentFaultError, match=sentence):
        CheckedEnv(Answers(begun=lambda: answer)).reset(seed=1)


@pytest.mark.parametrize(
    "answer",
    [
        GOOD,
        changed(0, [0, 1, 2]),
        changed(0, np.zeros(3, np.float64)),
        changed(0, np.zeros(3, np.uint8)),
        changed(1, np.float32(1)),
        changed(1, np.ones(1)),
        changed(1, True),
        changed(2, np.bool_(True)),
        changed(2, 1),
        changed(3, np.array([False])),
    ],
)
def test_what_stable_baselines_takes_passes_untouched(answer):
    assert CheckedEnv(Answers(lambda: answer)).step(0) is answer


def test_dicts_and_discrete_observations():
    space = spaces.Dict({"place": spaces.Box(-1, 1, (2,)), "kind": spaces.Discrete(3)})
    good = {"place": np.zeros(2), "kind": 1}
    for observation in (good, {**good, "kind": np.array([2])}, {**good, "more": "of it"}):
        CheckedEnv(Answers(lambda observation=observation: changed(0, observation), space=space)).step(0)
    for observation, sentence in (
        ({"place": np.zeros(2)}, "a dict with 'kind', 'place', got"),
        ({**good, "place": np.zeros(3)}, r"numbers of shape \(2,\) in 'place', got an array of shape \(3,\)"),
        (np.zeros(3), "a dict with 'kind', 'place', got an array"),
    ):
        with pytest.raises(EnvironmentFaultError, match=sentence):
            CheckedEnv(Answers(lambda observation=observation: changed(0, observation), space=space)).step(0)


@pytest.mark.parametrize("error", [KeyError("joint\n7"), EOFError(), OSError(5, "broken"), SystemExit(0)])
def test_every_exception_is_a_fault_with_its_place_and_its_traceback(error):
    with pytest.raises(EnvironmentFaultError) as caught:
        CheckedEnv(Answers(lambda: raise_(error))).step(0)
    assert str(caught.value).startswith(f"step() raised {type(error).__name__}")
    assert "\n" not in str(caught.value)
    assert f"({__file__}, line " in str(caught.value)
    assert caught.value.details.startswith("Traceback")


def test_a_ctrl_c_is_no_fault():
    with pytest.raises(KeyboardInterrupt):
        CheckedEnv(Answers(lambda: raise_(KeyboardInterrupt()))).step(0)


def test_what_goes_wrong_in_closing_is_a_warning():
    env = Answers()
    env.close = lambda: raise_(RuntimeError("no such window"))
    with pytest.warns(UserWarning, match=r"close\(\) of the environment raised RuntimeError: no such window"):
        CheckedEnv(env).close()


# ---------------------------------------------------------------- processes


@pytest.fixture
def processes():
    """A function that makes two environments in processes, the second by the given function."""
    made = []

    def make(second, start_method="fork"):  # forked processes share pipes: a dead one goes unnoticed
        functions = [lambda: Monitor(CheckedEnv(Answers())), lambda: Monitor(CheckedEnv(second()))]
        made.append(CheckedSubprocVecEnv(functions, start_method))
        return made[0]

    yield make
    for env in made:
        env.close()
        assert not any(process.is_alive() for process in env.processes)


@pytest.mark.parametrize(
    ("stepped", "sentence"),
    [
        (
            lambda: raise_(ValueError("in the simulator")),
            r"step\(\) raised ValueError: in the simulator .*, in process 1",
        ),
        (lambda: raise_(EOFError()), r"step\(\) raised EOFError .*, in process 1"),
        (lambda: sys.exit(0), r"step\(\) raised SystemExit: 0 .*, in process 1"),
        (lambda: changed(0, np.zeros(1)), r"must be numbers of shape \(3,\), got .*, in process 1"),
    ],
)
def test_a_fault_in_a_process_is_raised_here(processes, capfd, stepped, sentence):
    env = processes(lambda: Answers(stepped))
    env.reset()
    with pytest.raises(EnvironmentFaultError, match=sentence):
        env.step(np.zeros((2, 1)))
    env.close()
    assert capfd.readouterr().err == ""  # the process wrote no traceback


def test_a_fault_at_the_end_of_an_episode_is_raised_here(processes):
    answers = iter([(np.zeros(3), {}), None])
    env = processes(lambda: Answers(lambda: changed(2, True), lambda: next(answers)))
    env.reset()
    with pytest.raises(EnvironmentFaultError, match=r"reset\(\) must return .*, got None, in process 1"):
        env.step(np.zeros((2, 1)))


def test_a_fault_in_a_reset_or_a_method_is_raised_here(processes):
    env = processes(lambda: Answers(begun=lambda: raise_(KeyError("scene"))))
    assert env.env_method("compute", 2) == [0.5, 0.5]
    with pytest.raises(EnvironmentFaultError, match=r"ZeroDivisionError: division by zero .*, in process 0"):
        env.env_method("compute", 0, indices=0)
    with pytest.raises(EnvironmentFaultError, match=r"reset\(\) raised KeyError: 'scene' .*, in process 1"):
        env.reset()


def test_an_environment_that_cannot_be_made_in_its_process_is_named(processes, capfd):
    with pytest.raises(EnvironmentFaultError, match=r"KeyError: 'asset' .*, in process 1"):
        processes(lambda: raise_(KeyError("asset")))
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("end", "sentence"),
    [(lambda: os._exit(0), "ended with exit status 0"), (lambda: os.kill(os.getpid(), 9), "was ended by SIGKILL")],
)
def test_a_process_that_ends_is_named_with_how(processes, end, sentence):
    env = processes(lambda: Answers(end), "forkserver")
    env.reset()
    with pytest.raises(EnvironmentFaultError, match=f"the process of environment 1 {sentence}"):
        env.step(np.zeros((2, 1)))
    with pytest.raises(EnvironmentFaultError, match=f"the process of environment 1 {sentence}"):
        env.env_method("compute", 1)  # so does every later call
    with pytest.raises(EnvironmentFaultError, match=f"the process of environment 1 {sentence}"):
        processes(end, "forkserver")


@pytest.mark.parametrize("dying", [0, 2])
def test_environments_are_closed_after_the_death_of_any_process(dying):
    """The answers of the others to the same step may not have been received."""
    ends = [lambda: GOOD] * 3
    ends[dying] = lambda: os.kill(os.getpid(), 9)
    env = CheckedSubprocVecEnv([partial(CheckedEnv, Answers(end)) for end in ends], "forkserver")
    env.reset()
    with pytest.raises(EnvironmentFaultError, match=f"the process of environment {dying} was ended by SIGKILL"):
        env.step(np.zeros((3, 1)))
    closing = threading.Thread(target=env.close, daemon=True)
    closing.start()
    closing.join(30)
    assert not closing.is_alive()
    assert not any(process.is_alive() for process in env.processes)
