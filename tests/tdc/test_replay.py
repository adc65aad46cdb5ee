"""The packed rows of the fused update against SB3's replay buffer, bit for bit."""

import gc
import pickle
import weakref

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tdc.tdc.fused.replay import PackedReplay
from tests.helpers.tdc import HEADS, TwoActions, assert_close, make, states


def add_steps(buffers, count, rng):
    """Add the same random transitions to all buffers."""
    n_envs = buffers[0].n_envs
    for _ in range(count):
        observation, next_observation = rng.normal(size=(2, n_envs, 3))
        done = rng.random(n_envs) < 0.5
        infos = [{"TimeLimit.truncated": bool(rng.random() < 0.5)} for _ in range(n_envs)]
        action, reward = rng.normal(size=(n_envs, 2)), rng.normal(size=n_envs)
        for buffer in buffers:
            buffer.add(observation, next_observation, action, reward, done, infos)


def make_buffer(n_envs=1, **kwargs):
    env = TwoActions()
    space = gym.spaces.Box(-1, 1, (3,), np.float64)  # as MuJoCo's
    return ReplayBuffer(10 * n_envs, space, env.action_space, "cpu", n_envs=n_envs, **kwargs)


def draw(packed_replay, buffer, batch_size, steps):
    """Draw a minibatch in the form that SB3 returns."""
    rows = packed_replay.rows[packed_replay.draw(buffer, batch_size, steps)]
    observations, actions, next_observations, rewards, dones, timeouts = rows.split([3, 2, 3, 1, 1, 1], dim=1)
    return ReplayBufferSamples(observations, actions, next_observations, dones * (1 - timeouts), rewards)


@pytest.mark.parametrize("mirrored", [False, True], ids=["in place", "copied, as to a device"])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("kwargs", [{}, {"handle_timeout_termination": False}], ids=str)
def test_returns_what_the_buffer_returns(n_envs, mirrored, kwargs):
    """While the buffer fills, wraps around and stays full, with the same random numbers; packed after three steps."""
    plain, packed = make_buffer(n_envs, **kwargs), make_buffer(n_envs, **kwargs)
    rng = np.random.default_rng(0)
    add_steps([plain, packed], 3, rng)
    packed_replay, steps = PackedReplay(packed), 3
    if mirrored:
        packed_replay.rows = packed_replay.host_rows.clone()
    for added in (0, 1, 4, 2, 1, 0, 9, 5, 10, 3, 27):  # exactly full at the fourth
        add_steps([plain, packed], added, rng)
        steps += added
        np.random.seed(added)
        expected = plain.sample(20)
        np.random.seed(added)
        samples = draw(packed_replay, packed, 20, steps)
        for name, got, want in zip(expected._fields, samples, expected, strict=True):
            assert got is want is None or th.equal(got, want.float()), (added, name)
        np.random.seed(added)  # the buffer itself still works
        for name, got, want in zip(expected._fields, packed.sample(20), expected, strict=True):
            assert got is want is None or th.equal(got.float(), want.float()), (added, name)


def test_the_arrays_of_the_buffer_are_the_rows():
    """Changes by hand count, a saved buffer is complete and no larger, and a replaced array is noticed."""
    buffer = make_buffer()
    add_steps([buffer], 5, np.random.default_rng(0))
    packed_replay = PackedReplay(buffer)
    buffer.rewards[:] = 7
    buffer.dones[:], buffer.timeouts[:] = 1, 0
    samples = draw(packed_replay, buffer, 20, 5)
    assert (samples.rewards == 7).all()
    assert (samples.dones == 1).all()
    copy = pickle.loads(pickle.dumps(buffer))
    assert np.array_equal(copy.observations, buffer.observations)
    assert len(pickle.dumps(buffer)) < 2000 + packed_replay.slots.nbytes
    assert packed_replay.holds(buffer)
    assert not packed_replay.holds(copy)
    buffer.rewards = buffer.rewards.copy()
    assert not packed_replay.holds(buffer)


def test_buffers_and_models_are_freed():
    """They take most of a process's memory, and one process may make many: for seeds, for trials, in notebooks."""
    model = make(TwoActions(), fused=True, buffer_size=60).learn(150)
    assert model._fused_update.packed_replay is not None
    left = [weakref.ref(part) for part in (model, model.replay_buffer, model._fused_update.packed_replay)]
    del model
    gc.collect()
    assert [part() for part in left] == [None] * 3


@HEADS
def test_learning_is_the_same(stochastic_actor, monkeypatch):
    """Two environments, a buffer that wraps around, a second ``learn()``, fewer updates than steps."""
    models = []
    for packed in (False, True):
        if not packed:
            monkeypatch.setattr(PackedReplay, "applies", lambda buffer: False)
        env = make_vec_env(TwoActions, n_envs=2, seed=0)
        kwargs = {"buffer_size": 60, "train_freq": 3, "gradient_steps": 2, "stochastic_actor": stochastic_actor}
        model = make(env, fused=True, **kwargs).learn(150).learn(100)
        assert (model._fused_update.packed_replay is not None) is packed
        models.append(model)
        monkeypatch.undo()
    assert_close(*map(states, models), rtol=0, atol=0)


def test_saving_and_loading_packs_again(tmp_path):
    model = make(fused=True).learn(60)
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    before = model.replay_buffer
    model.load_replay_buffer(tmp_path / "buffer.pkl")
    assert np.array_equal(before.observations, model.replay_buffer.observations)
    model.learn(60)
    packed_replay = model._fused_update.packed_replay
    model.train(gradient_steps=1, batch_size=8)  # another update, the same rows
    assert model._fused_update.packed_replay is packed_replay
    assert model._fused_update.packed_replay.holds(model.replay_buffer)


def test_where_it_applies():
    assert PackedReplay.applies(make().replay_buffer)
    assert not PackedReplay.applies(make(n_steps=3).replay_buffer)
    replay_buffer_kwargs = {"handle_timeout_termination": False}
    lean = make(optimize_memory_usage=True, replay_buffer_kwargs=replay_buffer_kwargs)
    assert not PackedReplay.applies(lean.replay_buffer)
    own = make()
    own.replay_buffer.sample = own.replay_buffer.sample
    assert not PackedReplay.applies(own.replay_buffer)
    packed = make(fused=True).learn(60)
    replay = packed._fused_update.packed_replay
    packed.replay_buffer.sample = packed.replay_buffer.sample  # whatever a user puts there
    assert not replay.holds(packed.replay_buffer)
    integers = gym.spaces.Box(0, 255, (3,), np.int64)  # float32 cannot hold them all
    assert not PackedReplay.applies(ReplayBuffer(10, integers, TwoActions().action_space, "cpu"))
    normalized = make(VecNormalize(make_vec_env("Pendulum-v1")), fused=True).learn(60)
    assert normalized._fused_update.packed_replay is None
