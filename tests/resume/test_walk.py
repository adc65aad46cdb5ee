"""Objects captured as JSON and arrays, and restored, compared by what a user would see."""

import collections
import enum
import functools
import json
import random
import re
import sys
import threading
import types

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sb3_tdc.resume.kinds.arrays import run_lengths
from sb3_tdc.resume.kinds.table import KINDS
from sb3_tdc.resume.walk import MISSING, Capture, NotCapturedError, NotRestoredError, Restore
from tests.helpers.values import LENT


class Colour(enum.Enum):
    RED = 1
    BLUE = 2


class Point:
    def __init__(self, x, friend=None):
        self.x, self.friend = x, friend


class Slotted:
    __slots__ = ("a", "b")


def there_and_back(value, existing=MISSING):
    context = Capture(KINDS)
    node = json.loads(json.dumps(context.capture(value, "value")))
    return Restore(KINDS, context.arrays).restore(node, existing, "value")


def same(a, b):
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    return type(a) is type(b) and (a == b or a != a)


scalars = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary()
trees = st.recursive(
    scalars,
    lambda children: (
        st.lists(children)
        | st.tuples(children, children)
        | st.dictionaries(st.text() | st.integers() | st.none(), children)
    ),
    max_leaves=20,
)


@settings(deadline=None)
@given(trees)
def test_trees_come_back(tree):
    assert repr(there_and_back(tree)) == repr(tree)  # NaN, −0 and types included


@settings(deadline=None)
@given(hnp.arrays(hnp.scalar_dtypes() | hnp.unicode_string_dtypes(), hnp.array_shapes(min_dims=0, min_side=0)))
def test_arrays_come_back_bit_by_bit(array):
    assert same(there_and_back(array), array)


@pytest.mark.parametrize("dtype", [np.int64, bool, np.uint8])
def test_long_runs_are_small_and_come_back(dtype):
    array = np.repeat(np.arange(50), 1000).reshape(500, 100).astype(dtype)
    context = Capture(KINDS)
    context.capture(array, "array")
    assert sum(part.nbytes for part in context.arrays) < array.nbytes / 8
    assert same(there_and_back(array), array)
    assert run_lengths(np.arange(50_000)) is None  # nothing to gain


@pytest.mark.parametrize(
    "value",
    [
        collections.deque([1, 2.5], maxlen=7), {1, "a"}, frozenset({3}), np.float32(0.1), np.int64(-3), b"\x00\xff",
        [1.5] * 100, [True, False] * 50, th.arange(5, dtype=th.float64), np.array([{"a": 1}, [2]], dtype=object),
    ],
    ids=lambda value: type(value).__name__,
)  # fmt: skip
def test_values_come_back(value):
    back = there_and_back(value)
    assert type(back) is type(value)
    if isinstance(value, th.Tensor):
        assert th.equal(back, value)
    elif isinstance(value, np.ndarray):
        assert back.tolist() == value.tolist()
    else:
        assert back == value
        assert getattr(back, "maxlen", None) == getattr(value, "maxlen", None)


@pytest.mark.parametrize(
    "make",
    [
        lambda: np.random.default_rng(1),
        lambda: np.random.Generator(np.random.MT19937(1)),
        lambda: np.random.RandomState(1),
        lambda: random.Random(1),
        lambda: th.Generator().manual_seed(1),
    ],
)
def test_generators_go_on(make):
    def draw(generator):
        if isinstance(generator, th.Generator):
            return th.rand(5, generator=generator).tolist()
        return [float(getattr(generator, "normal", getattr(generator, "gauss", None))(0, 1)) for _ in range(5)]

    generator, other = make(), make()
    draw(generator)
    context = Capture(KINDS)
    node = context.capture([generator], "generators")
    expected = draw(generator)
    draw(other), draw(other)
    (restored,) = Restore(KINDS, context.arrays).restore(node, [other], "generators")
    assert restored is other  # whatever holds it continues with it
    assert draw(restored) == expected
    (made,) = Restore(KINDS, context.arrays).restore(node, [], "generators")
    assert draw(made) == expected


@pytest.mark.parametrize("lend", LENT)
def test_arrays_in_memory_that_numpy_did_not_make_come_back(lend):
    there = lend([3.0, 4.0])
    assert there_and_back(lend([1.0, 2.0]), there) is there
    assert there.tolist() == [1, 2]
    fixed, short = lend([3.0, 4.0]), lend([3.0])
    fixed.flags.writeable = False
    for other in (MISSING, fixed, short, np.zeros(2, np.float32), None):
        assert there_and_back(lend([1.0, 2.0]), other).tolist() == [1, 2]
    assert (fixed.tolist(), short.tolist()) == ([3, 4], [3])


@pytest.mark.parametrize("lend", LENT[:3])
def test_views_of_such_memory_do_not_write_into_each_other(lend):
    whole = lend([5.0, 6.0, 7.0])
    there = [whole, whole[1:]]
    assert [part.tolist() for part in there_and_back([lend([1.0, 2, 3]), lend([4.0, 5])], there)] == [[1, 2, 3], [4, 5]]
    whole = lend([1.0, 2.0, 3.0])
    assert [part.tolist() for part in there_and_back([whole, whole[1:]], there)] == [[1, 2, 3], [2, 3]]


BALL = "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"


def fallen(n_steps):
    data = mujoco.MjData(mujoco.MjModel.from_xml_string(BALL))
    for _ in range(n_steps):
        mujoco.mj_step(data.model, data)
    return data


@pytest.mark.parametrize("is_first", [True, False])
def test_views_of_mujoco_stay_views_and_their_numbers_are_kept_once(is_first):
    def build(data):
        views = [data.qpos, data.qvel[2:], data.body(1).xpos, data.model.body_mass]
        return [views, data, data.model] if is_first else [data, data.model, views]

    then, now, alone = fallen(5), fallen(0), Capture(KINDS)
    alone.capture(then, "data")
    there = build(now)
    context = Capture(KINDS)
    node = json.loads(json.dumps(context.capture(build(then), "value")))
    assert len(context.arrays) == len(alone.arrays) + (4 if is_first else 0)
    Restore(KINDS, context.arrays).restore(node, there, "value")
    views = there[0] if is_first else there[2]
    assert [view.tolist() for view in views] == [view.tolist() for view in build(then)[0 if is_first else 2]]
    mujoco.mj_step(now.model, now)
    assert views[0].tolist() == now.qpos.tolist() == fallen(6).qpos.tolist()


def test_a_view_of_native_memory_is_there_with_its_shape_or_refused():
    data, now = fallen(5), fallen(0)
    context = Capture(KINDS)
    node = json.loads(json.dumps(context.capture(data.qpos, "x")))
    fixed = now.qpos
    fixed.flags.writeable = False
    for other, why in (
        (MISSING, "is nothing"),
        (np.zeros(7), "was a view"),
        (now.qvel, "was a view"),
        (fixed, "cannot"),
    ):
        with pytest.raises(NotRestoredError, match=f"^x .*{why}"):
            Restore(KINDS, context.arrays).restore(node, other, "x")
    assert Restore(KINDS, context.arrays).restore(node, data.qpos, "x").tolist() == data.qpos.tolist()


def test_memory_of_what_is_left_out_is_no_other_memory():
    array, context = np.zeros(3), Capture(KINDS)
    assert context.capture_optional([array, threading.Lock()], "x") is MISSING
    context.capture([np.ones(3), array], "y")
    assert context.shared_memory() == {}


def test_an_owner_of_memory_that_is_left_out_does_not_count():
    data = fallen(5)
    context = Capture(KINDS)
    assert context.capture_optional([data, threading.Lock()], "x") is MISSING
    node = context.capture_optional(data.qpos, "y")
    there = fallen(0)
    Restore(KINDS, context.arrays).restore(node, there.qpos, "y")
    assert there.qpos.tolist() == data.qpos.tolist()


def test_objects_are_kept_and_shared_ones_stay_shared():
    shared = np.arange(3)
    before = Point([shared], Point(shared))
    before.friend.friend = before
    there = Point(None, Point(None))
    friend = there.friend
    assert there_and_back(before, there) is there
    assert there.friend is friend
    assert friend.friend is there
    assert there.x[0] is friend.x
    assert there.x[0].tolist() == [0, 1, 2]


def test_attributes_that_were_not_there_go():
    there = Point(1)
    there.cache = 3
    there_and_back(Point(2), there)
    assert vars(there) == {"x": 2, "friend": None}
    slotted, other = Slotted(), Slotted()
    slotted.a = 5
    other.a, other.b = 1, 2
    there_and_back(slotted, other)
    assert other.a == 5
    assert not hasattr(other, "b")


def test_functions_go_on_with_what_they_enclose():
    def make_counter():
        count = 0

        def counter():
            nonlocal count
            count += 1
            return count

        return counter

    counter, other = make_counter(), make_counter()
    counter(), counter()
    there_and_back(Point(counter), Point(other))
    assert other() == 3
    ordered = there_and_back(
        [functools.partial(max, 3), Colour.RED, collections.OrderedDict(a=1)],
        [functools.partial(max, 1), Colour.BLUE, collections.OrderedDict()],
    )
    assert (ordered[0](2), ordered[1], type(ordered[2])) == (3, Colour.RED, collections.OrderedDict)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (Point([threading.Lock()]), "value.x[0] is a _thread.lock"),
        (Point({"a": iter([1])}), "value.x['a'] is a builtins.list_iterator"),
        (Point(open), None),
        (Point(x for x in ()), "value.x is a builtins.generator"),
        (gym.make("CartPole-v1").unwrapped, None),
    ],
    ids=str,
)
def test_what_can_hide_a_state_is_refused_by_its_path(value, message):
    if message is None:
        Capture(KINDS).capture(value, "value")
    else:
        with pytest.raises(NotCapturedError, match=re.escape(message)):
            Capture(KINDS).capture(value, "value")


@pytest.mark.parametrize(
    ("before", "there"),
    [(Point(1), Slotted()), (Point(len), Point(max)), (Point(Point(1)), Point(None))],
)
def test_what_does_not_fit_is_refused(before, there):
    with pytest.raises(NotRestoredError, match="value"):
        there_and_back(before, there)


def test_a_simulator_behind_a_number_is_not_taken_for_its_state(monkeypatch):
    """Like PyBullet's client: a Python object whose state is elsewhere."""
    monkeypatch.setattr(sys.modules[__name__], "p", types.ModuleType("pybullet"), raising=False)
    with pytest.raises(NotCapturedError, match="uses pybullet"):
        Capture(KINDS).capture(Point(0), "env")
