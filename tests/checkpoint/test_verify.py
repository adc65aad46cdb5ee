"""What a callback holds comes back as it was, its class too, or is named; nothing of it ends training."""

import io
import json
import re

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from sb3_tdc.checkpoint import state
from tests.checkpoint.values import BOXES, LEAVES, alike, build


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
    As in two processes: what is built holds ``before``; what is captured, ``after``.

    :return: what the second process holds in the end, and all that was named
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
    assert context.not_restored == []  # it was known when it was captured
    return now, [second.x, second.y], named


def build_both(recipes):
    built = []
    return [build(recipe, built) for recipe in recipes]


recipes = st.recursive(
    st.sampled_from(sorted(LEAVES)) | st.tuples(st.just("same"), st.integers(0, 5)),
    lambda parts: st.tuples(st.sampled_from(sorted(BOXES)), st.lists(parts, max_size=4)),
    max_leaves=8,
)


@settings(deadline=None, max_examples=150)
@given(st.tuples(recipes, recipes), st.tuples(recipes, recipes))
def test_whatever_a_callback_holds_comes_back_or_is_named(model, before, after):
    now, restored, named = there_and_back(model, before, after)
    if not named:
        assert alike(now, restored)
        return
    original = build_both(before)
    for name, value, found, built in zip("xy", now, restored, original, strict=True):
        if any(re.match(rf"callbacks\.callbacks\[0\]\.{name}\b", why) for why in named):
            continue
        assert alike(value, found), (named, built)


@pytest.mark.parametrize("leaf", LEAVES)
@pytest.mark.parametrize("before", ["None", "list", "itself"])
def test_every_kind_comes_back_or_is_named(model, leaf, before):
    """Where there was nothing, in a list that grows, and where there was the same."""
    now, there = {"None": (leaf, "None"), "list": (("list", [leaf, leaf]), ("list", [])), "itself": (leaf, leaf)}[
        before
    ]
    value, restored, named = there_and_back(model, (there, "None"), (now, "None"))
    assert named or alike(value, restored)
    assert all(why.startswith("callbacks.callbacks[0].x") for why in named)


# Those that a user may expect to be kept, also where there was nothing when the run began
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
    if (before, after) != ("views", "no views"):  # three arrays, each its own again
        assert len(named) >= 1
        assert all(why.startswith("callbacks.callbacks[0].x") for why in named)
