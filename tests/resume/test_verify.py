"""The values of a callback come back as they were, with their classes, or are named; none of them ends training."""

import io
import json
import re
import threading
import time
import warnings
from contextlib import nullcontext
from pathlib import Path
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecFrameStack, VecMonitor, VecNormalize

from sb3_tdc.envs.vector import GymnasiumVecEnv
from sb3_tdc.resume import ResumeCallback
from sb3_tdc.resume import run_state as state
from sb3_tdc.resume.kinds.table import KINDS
from tests.helpers.values import BOXES, LEAVES, LENT, Colour, Node, alike, build
from tests.tools.runs import Reach, Stop, StopAt


class Holds(BaseCallback):
    """A user's callback."""

    def __init__(self, *values):
        super().__init__()
        self.x, self.y = values

    def _on_step(self):
        return True


class Still(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, False, False, {}


def make_model():
    small = {"policy_kwargs": {"net_arch": [2]}, "buffer_size": 10, "learning_starts": 100, "device": "cpu"}
    return SAC("MlpPolicy", Still(), seed=1, **small)


@pytest.fixture(scope="module")
def model():
    return make_model().learn(1)


def there_and_back(model, before, after):
    """
    Capture a callback and restore it, as in two processes.

    :param before: recipes of the two values that the callback is built with, in both processes
    :param after: recipes of the two values that it holds when it is captured
    :return: the values captured, the values in the second process in the end, and the sentences on what was left out
    """
    first = Holds(*build_both(before))
    root = CallbackList([first])
    _, initial = state.verify(model, root)
    first.x, first.y = now = build_both(after)
    parts, context = state.capture_state(model, root, initial)
    text, file = json.dumps(parts), io.BytesIO()
    np.savez(file, allow_pickle=False, **{str(i): array for i, array in enumerate(context.arrays)})
    named = list(context.left_out)

    second = Holds(*build_both(before))
    root = CallbackList([second])
    state.verify(model, root)
    with np.load(io.BytesIO(file.getvalue()), allow_pickle=False) as arrays:
        numbered = [arrays[str(i)] for i in range(len(arrays.files))]
    context = state.restoring(model, numbered)
    state.restore_state(model, root, json.loads(text), context)
    assert context.not_restored == []  # all that will not be restored is known when it is captured
    return now, [second.x, second.y], named


def build_both(recipes):
    built = []
    return [build(recipe, built) for recipe in recipes]


recipes = st.recursive(
    st.sampled_from(sorted(LEAVES)) | st.tuples(st.just("same"), st.integers(0, 5)),
    lambda parts: st.tuples(st.sampled_from(sorted(BOXES)), st.lists(parts, max_size=4)),
    max_leaves=8,
)


@settings(deadline=None, max_examples=100)
@given(st.tuples(recipes, recipes), st.tuples(recipes, recipes))
def test_whatever_a_callback_holds_comes_back_or_is_named(model, before, after):
    now, restored, named = there_and_back(model, before, after)
    if not named:
        assert alike(now, restored)
        return
    original = build_both(before)
    for name, value, found, built in zip("xy", now, restored, original, strict=True):
        # Compared one by one: where one attribute is left out, the other no longer shares objects with it
        if any(re.match(rf"callbacks\.callbacks\[0\]\.{name}\b|.* share their memory", why) for why in named):
            continue
        assert alike(value, found), (named, built)


@pytest.mark.parametrize("leaf", LEAVES)
@pytest.mark.parametrize("before", ["None", "list", "itself"])
def test_every_kind_comes_back_or_is_named(model, leaf, before):
    """In the place of None, in a list that grows, and in the place of the same value."""
    now, there = {"None": (leaf, "None"), "list": (("list", [leaf, leaf]), ("list", [])), "itself": (leaf, leaf)}[
        before
    ]
    value, restored, named = there_and_back(model, (there, "None"), (now, "None"))
    assert named or alike(value, restored)
    assert all(why.startswith("callbacks.callbacks[0].x") for why in named)


# What a user may expect to be kept, even if it was not there when training began
KEPT = ["path", "numpy's type", "torch's type", "device", "missing lists", "counted", "array", "tensor", "parameter"]
KEPT += ["tensor with a gradient", "red", "path keys", "a large integer", "complex", "surrogates", "other generator"]
KEPT += ["structured", "objects in an array", "cyclic", "int", "long integers", "long unsigned", "float32", "range"]
KEPT_IN_PLACE = [*KEPT, "module", "optimizer", "views", "counter", "a default", "method", "partial", "enum keys"]
KEPT_IN_PLACE += ["record", "names", "mean", "numpy", "missing counters", "spawned", "tensor and array", "a lambda"]


@pytest.mark.parametrize("leaf", KEPT)
def test_what_is_made_from_its_content_alone_is_kept(model, leaf):
    now, restored, named = there_and_back(model, ("None", ("list", [])), (leaf, ("list", [leaf, leaf])))
    assert (alike(now, restored), named) == (True, [])


@pytest.mark.parametrize("leaf", KEPT_IN_PLACE)
def test_what_was_there_when_training_began_is_kept(model, leaf):
    now, restored, named = there_and_back(model, (leaf, "None"), (leaf, "None"))
    assert (alike(now, restored), named) == (True, [])


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("other path", "path"), ("array", "other array"), ("counter", "other counter"), ("partial", "other partial"),
        ("a default", "another default"), (("list", ["red"]), ("list", ["blue", "red"])),
        (("node", ["array"]), ("node", ["other array"])), (("dict", ["record"]), ("dict", ["record"])),
    ],
)  # fmt: skip
def test_what_changes_is_kept(model, before, after):
    now, restored, named = there_and_back(model, (before, "None"), (after, "None"))
    assert (alike(now, restored), named) == (True, [])


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (("list", []), ("list", ["record"])), ("None", ("node", [])), ("a lambda", "another lambda"),
        ("len", "max"), ("numpy", "torch"), ("add", "multiply"), ("list of int", "list of str"),
        ("method", "other method"), ("views", "no views"), ("no views", "views"), ("views", "shifted views"),
        ("None", "lock"), ("None", "deep"), ("None", "nan as a key"),
        (("list", ["record", ("same", 0)]), ("list", ["record"] * 2)),
    ],
)  # fmt: skip
def test_what_will_not_come_back_is_named(model, before, after):
    _, _, named = there_and_back(model, (before, "None"), (after, "None"))
    if (before, after) != ("views", "no views"):  # separate arrays can be made from their content
        assert len(named) >= 1
        assert all(why.startswith("callbacks.callbacks[0].x") for why in named)


# ---------------------------------------------------------------- in a run


class Grows(BaseCallback):
    """A callback whose values can be captured when training begins, but no longer from step 30 on."""

    def __init__(self):
        super().__init__()
        self.notes, self.lock, self.count = [], None, 0

    def _on_step(self):
        self.count += 1
        if self.num_timesteps == 30:
            self.notes.append(Node(1))
            self.lock = threading.Lock()
        return True


def run(folder, callback, stop_at=None, env=None):
    model = make_model() if env is None else make_model_on(env)
    states = ResumeCallback(folder, freq=20, verbose=0)
    try:
        states.select(model)
        model.learn(100, callback=[states, callback, StopAt(stop_at)])
    except Stop:
        pass
    finally:
        states.store.close()
    return states, model


def test_what_cannot_be_captured_any_more_is_named_once_and_ends_nothing(tmp_path):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run(tmp_path, Grows(), stop_at=90)
    named = [str(warning.message) for warning in caught if "Not in the resume states" in str(warning.message)]
    where = "Not in the resume states: callbacks.callbacks[1]"
    assert named == [
        f"{where}.notes[0] is a tests.helpers.values.Node, which was not there when training began",
        f"{where}.lock is a _thread.lock",
    ]
    grows = Grows()
    run(tmp_path, grows)
    assert (grows.count, grows.notes, grows.lock) == (100, [], None)  # the count is restored, the others are as built


def test_a_usual_run_has_nothing_to_name_and_verifies_in_no_time(tmp_path):
    """Verifying does not restore the files of the run, only its objects."""
    model = SAC("MlpPolicy", "HalfCheetah-v5", seed=1, device="cpu", learning_starts=10, buffer_size=200_000)
    states = ResumeCallback(tmp_path, freq=20, verbose=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(50, callback=states)
        start = time.perf_counter()
        assert states.verify(model) == []
        assert time.perf_counter() - start < 0.5
    states.store.close()


def test_verify_can_be_called_before_training(tmp_path):
    model = make_model()
    model.lock = threading.Lock()
    states = ResumeCallback(tmp_path, verbose=0)
    assert states.verify(model) == ["model.lock is a _thread.lock"]
    states.store.close()


def test_verify_compares_without_the_code_that_restores(model, monkeypatch):
    """A kind whose ``restore`` is broken is noticed, whichever it is."""
    holds = Holds(bytearray(b"ab"), [1, 2])
    monkeypatch.setattr(KINDS["bytearray"], "restore", lambda context, content, existing, path: existing + b"c")
    names, _ = state.verify(model, CallbackList([holds]))
    assert "callbacks.callbacks[0].x does not come back as it was" in names
    assert not any(name.startswith("callbacks.callbacks[0].y") for name in names)


class Draws(Still):
    """An environment whose restore fails: its ``part`` is of another class in the second process."""

    kind = Node

    def __init__(self):
        self.part, self.drawn = self.kind(), []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.uniform(-1, 1, 1).astype(np.float32), {}

    def step(self, action):
        self.drawn.append(self.np_random.uniform())
        return np.zeros(1, np.float32), self.drawn[-1], False, False, {}


def make_model_on(env):
    small = {"policy_kwargs": {"net_arch": [2]}, "buffer_size": 200, "learning_starts": 100, "device": "cpu"}
    return SAC("MlpPolicy", env, seed=1, **small)


class Walks(Still):
    """An environment whose state is a new array at every step, in memory that another library owns."""

    observation_space = gym.spaces.Box(-1e3, 1e3, (2,))

    def __init__(self, lend):
        self.lend, self.seen = lend, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.lend(self.np_random.uniform(size=2))
        return self.state.astype(np.float32), {}

    def step(self, action):
        self.state = self.lend(self.state + np.array([1.0, action[0]]))
        self.seen.append(self.state.tolist())
        return self.state.astype(np.float32), 0.0, False, False, {}


@pytest.mark.parametrize("lend", LENT)
def test_an_environment_with_its_state_in_such_memory_continues(tmp_path, lend):
    seen = {}
    for name, stops in (("whole", [None]), ("mine", [45, None])):
        for stop_at in stops:
            env = Walks(lend)
            run(tmp_path / name, Holds(1, 2), stop_at, env)
        seen[name] = env.seen
    assert seen["mine"] == seen["whole"]


class Helped(VecEnvWrapper):
    """A user's wrapper."""

    def __init__(self, venv, helper):
        super().__init__(venv)
        self.helper, self.steps = helper, 0

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        self.steps += 1
        return self.venv.step_wait()


class OtherHelped(Helped):
    pass


def normalised(helper, wrapper=Helped):
    return VecNormalize(wrapper(DummyVecEnv([lambda: Walks(np.array)]), helper))


def statistics(env):
    return [env.obs_rms.mean.tolist(), env.obs_rms.count, env.ret_rms.var.tolist(), env.returns.tolist()]


@pytest.mark.parametrize(
    ("helpers", "sentence"),
    [
        ([threading.Lock, threading.Lock], r"Not in the resume states: env\.venv\.helper is a _thread\.lock"),
        ([lambda: Node(iter("a"))] * 2, r"Not in the resume states: env\.venv\.helper\.item is a .*iterator"),
        ([Node, list], r"Not restored: env\.venv\.helper was a .*Node, and is a .*list"),
    ],
)
def test_what_a_wrapper_of_environments_loses_is_named_and_all_else_continues(tmp_path, helpers, sentence):
    whole, first, second = (normalised(helper()) for helper in (helpers[0], *helpers))
    run(tmp_path / "whole", Holds(1, 2), env=whole)
    run(tmp_path / "mine", Holds(1, 2), stop_at=45, env=first)
    with pytest.warns(RuntimeWarning, match=sentence):
        run(tmp_path / "mine", Holds(1, 2), env=second)
    assert statistics(second) == statistics(whole)
    assert second.venv.steps == whole.venv.steps == 100
    assert second.get_attr("seen") == whole.get_attr("seen")


class Simulator(gym.vector.VectorEnv):
    """Two environments in one object that Python cannot see into."""

    metadata: ClassVar = {"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP}
    num_envs, single_observation_space, single_action_space = 2, Still.observation_space, Still.action_space

    def __init__(self):
        self.lock, self.steps, self.drawn = threading.Lock(), 0, []

    def draw(self):
        self.drawn.append(self.np_random.normal(size=(2, 1)).astype(np.float32))
        return self.drawn[-1]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.draw(), {}

    def step(self, action):
        self.steps += 1
        observations, ends = self.draw(), np.full(2, self.steps % 7 == 0)
        infos = {"final_obs": observations, "_final_obs": ends} if ends[0] else {}
        return observations, observations[:, 0], np.zeros(2, bool), ends, infos


class Statistics(BaseCallback):
    is_captured = False

    def __init__(self, env):
        super().__init__()
        self.env, self.seen = env, {}

    def _on_rollout_start(self):
        returns, monitor = self.env.ret_rms, self.env.venv.venv
        self.seen[self.num_timesteps] = returns.var.tolist(), returns.count, monitor.episode_count

    def _on_step(self):
        return True


def test_what_lies_around_environments_that_cannot_be_captured_continues(tmp_path):
    seen, drawn = [], []
    for stop_at in (50, None):
        simulator = Simulator()
        monitor = VecMonitor(GymnasiumVecEnv(simulator), str(tmp_path / "monitor.csv"))
        env = VecNormalize(VecFrameStack(monitor, 2))
        told = pytest.warns(RuntimeWarning, match="new episodes.*lock") if stop_at is None else nullcontext()
        watch = Statistics(env)
        with told:
            run(tmp_path / "states", watch, stop_at, env)
        drawn.append([part.tolist() for part in simulator.drawn])
        seen.append((watch.seen, (tmp_path / "monitor.csv").read_text().splitlines()[2:]))
    (before, first_rows), (after, rows) = seen
    assert min(after) == 40
    assert after[40] == before[40]
    assert rows[:4] == first_rows[:4]  # of the two episodes of each environment that had ended
    assert len(rows) == after[98][2]
    # The first run drew for a reset and 20 steps until then; the second, for the reset with which learn() begins
    assert drawn[1][1:5] == drawn[0][21:25]


@pytest.mark.parametrize("is_outer", [True, False])
def test_a_wrapper_of_another_class_starts_episodes_again_and_ends_nothing(tmp_path, is_outer):
    def build(wrapper):
        env = DummyVecEnv([lambda: Walks(np.array)])
        return wrapper(VecNormalize(env), 1) if is_outer else VecNormalize(wrapper(env, 1))

    run(tmp_path, Holds(1, 2), stop_at=45, env=build(Helped))
    env = build(OtherHelped)
    with pytest.warns(RuntimeWarning) as caught:
        run(tmp_path, Holds(1, 2), env=env)
    told = "\n".join(str(warning.message) for warning in caught)
    assert f"Not restored: env{'' if is_outer else '.venv'} was a" in told
    assert "Continuing with new episodes" in told
    assert is_outer or env.ret_rms.count > 100


class Informs(Reach):
    """An environment whose infos hold one more value, made from a recipe, after step 15."""

    def __init__(self, leaf):
        super().__init__()
        self.leaf, self.count = leaf, 0

    def step(self, action):
        *results, info = super().step(action)
        self.count += 1
        info |= {"force": np.float32(self.count), "path": Path("a"), "colours": [Colour.RED]}
        return (*results, info | {"part": build(self.leaf)} if self.count > 15 else info)


def run_with_infos(folder, leaf, stop_at=None):
    kwargs = {"replay_buffer_class": HerReplayBuffer, "replay_buffer_kwargs": {"copy_info_dict": True}}
    kwargs |= {"policy_kwargs": {"net_arch": [2]}, "buffer_size": 200, "learning_starts": 60, "batch_size": 4}
    model = SAC("MultiInputPolicy", Informs(leaf), seed=1, device="cpu", **kwargs)
    states = ResumeCallback(folder, freq=20, verbose=0)
    try:
        states.select(model)
        model.learn(100, callback=[states, StopAt(stop_at)])
    except Stop:
        pass
    finally:
        states.store.close()
    return [info for (info,) in model.replay_buffer.infos[:100]]


@pytest.mark.parametrize(
    "leaf",
    [
        "record",
        ("list", ["red", "record"]),
        ("dict", ["array", ("node", [])]),
        "iterator",
        "nan as a key",
        "deep",
        "counter",
    ],
)  # fmt: skip
def test_what_will_not_come_back_of_infos_is_named_once_and_left_out(tmp_path, leaf):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        whole = run_with_infos(tmp_path, leaf, stop_at=70)
    named = [str(warning.message) for warning in caught if "Not in the resume states" in str(warning.message)]
    assert len(named) == 1
    assert re.match(r"Not in the resume states: replay_buffer\.infos\[.part.\]", named[0])
    infos = run_with_infos(tmp_path, leaf)
    assert all("part" in info for info in whole[15:69] + infos[60:])
    assert not any("part" in info for info in infos[15:60])
    for info, expected in zip(infos[:60], whole, strict=False):
        assert alike(info, {key: value for key, value in expected.items() if key != "part"})


@pytest.mark.parametrize(
    "leaf", ["array", ("dict", ["float32", "blue"]), ("deque", ["path", "int array"]), "counted", "structured"]
)
def test_infos_that_are_made_from_their_content_come_back(tmp_path, leaf):
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        whole = run_with_infos(tmp_path, leaf, stop_at=70)
        infos = run_with_infos(tmp_path, leaf)
    assert all(alike(info, expected) for info, expected in zip(infos[:60], whole, strict=False))


def test_an_environment_whose_restore_fails_does_not_repeat_its_draws(tmp_path, monkeypatch):
    first = Draws()
    run(tmp_path, Holds(1, 2), stop_at=45, env=first)
    monkeypatch.setattr(Draws, "kind", type("Other", (Node,), {}))
    second = Draws()
    with pytest.warns(RuntimeWarning, match=r"with new episodes.*part was a .*Node, and is a .*Other"):
        run(tmp_path, Holds(1, 2), env=second)
    assert not set(first.drawn[:40]) & set(second.drawn[-60:])


def test_an_attribute_whose_restore_fails_stays_as_built_and_the_others_do_not(tmp_path):
    run(tmp_path, Holds(Node([1]), 5), stop_at=45)
    holds = Holds([7], 6)
    with pytest.warns(
        RuntimeWarning, match=r"Not restored: callbacks\.callbacks\[1\]\.x was a .*Node, and is a .*list"
    ):
        run(tmp_path, holds)
    assert (holds.x, holds.y) == ([7], 5)


def test_a_path_in_the_folder_moves_with_it_and_others_stay(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    paths = [Path("run/notes.txt"), tmp_path / "run" / "notes.txt", Path("other/notes.txt")]
    run(Path("run/states"), Holds(paths, None), stop_at=45)
    (tmp_path / "run").rename(tmp_path / "moved")
    monkeypatch.chdir(tmp_path / "elsewhere")
    holds = Holds([], None)
    run(Path("../moved/states"), holds)
    assert holds.x == [Path("../moved/notes.txt"), Path("../moved/notes.txt"), Path("other/notes.txt")]


@pytest.mark.parametrize(
    ("one", "apart"),
    [
        ("array", "other array"),
        ("generator", "other generator"),
        ("missing lists", ("list", [])),
        ("tensor", "parameter"),
    ],
)
def test_what_was_one_and_is_two_now_does_not_become_one_again(model, one, apart):
    now, restored, named = there_and_back(model, (one, ("same", 0)), (one, apart))
    assert (alike(now, restored), named) == (True, [])


def test_arrays_that_no_longer_share_their_memory_do_not_write_into_each_other(model):
    before, after = ("views", "None"), ("other arrays of these shapes", "None")
    now, restored, named = there_and_back(model, before, after)
    assert (alike(now, restored), named) == (True, [])
