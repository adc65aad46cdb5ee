"""Gymnasium's vector environments against SB3's ``DummyVecEnv``, transition by transition."""

import threading
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from sb3_tdc import TDC, ResumeCallback
from sb3_tdc.cli import enjoy, train
from sb3_tdc.envs.vector import GymnasiumVecEnv, split_infos
from sb3_tdc.hyperparams import parse
from sb3_tdc.runs.models import make_model
from tests.helpers.command_line import SMALL

MODES = [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED]


class Counts(gym.Env):
    """Counts its steps; episodes of the given lengths terminate and are truncated in turn."""

    observation_space = gym.spaces.Dict(
        {"step": gym.spaces.Box(0, 100, (1,), np.float32), "episode": gym.spaces.Box(0, 100, (1,), np.float32)}
    )
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, lengths):
        self.lengths, self.episode = lengths, -1

    def _observe(self):
        return {"step": np.float32([self.t]), "episode": np.float32([self.episode])}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.episode = 0, self.episode + 1
        return self._observe(), {"began": self.episode}

    def step(self, action):
        self.t += 1
        over = self.t == self.lengths[self.episode % len(self.lengths)]
        by_time = over and self.episode % 2 == 1
        info = {"t": self.t, "nested": {"double": 2.0 * self.t}, "name": f"step {self.t}"}
        return self._observe(), float(action[0]), over and not by_time, by_time, info


def alike(one, other):
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            alike(one[key], other[key])
    elif isinstance(one, str):
        assert one == other
    else:
        np.testing.assert_array_equal(np.asarray(one, dtype=float), np.asarray(other, dtype=float))


def compare(functions, vector, n_steps, action_space, seed=3):
    """
    Step both with the same actions, and compare all that they return.

    :return: number of episodes that ended
    """
    expected, found = DummyVecEnv(functions), GymnasiumVecEnv(vector)
    for env in (expected, found):
        env.seed(seed)
    alike(expected.reset(), found.reset())
    alike(expected.reset_infos[0], found.reset_infos[0])
    rng = np.random.default_rng(0)
    n_ended = 0
    for _ in range(n_steps):
        actions = rng.uniform(action_space.low, action_space.high, (len(functions), *action_space.shape))
        results = [env.step(actions.astype(np.float32)) for env in (expected, found)]
        (obs, rewards, dones, infos), (obs_, rewards_, dones_, infos_) = results
        alike(obs, obs_)
        np.testing.assert_array_equal(rewards, rewards_)
        np.testing.assert_array_equal(dones, dones_)
        for i, (info, info_) in enumerate(zip(infos, infos_, strict=True)):
            if not dones[i]:
                info = {k: v for k, v in info.items() if k != "TimeLimit.truncated"}
            alike(info, info_)
            if dones[i]:
                n_ended += 1
                alike(expected.reset_infos[i], found.reset_infos[i])
    found.close()
    return n_ended


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("env_id", ["Hopper-v4", "Pendulum-v1"])
def test_it_is_the_dummy_on_real_tasks(env_id, mode):
    functions = [lambda: gym.make(env_id, max_episode_steps=50)] * 3
    space = functions[0]().action_space
    assert compare(functions, SyncVectorEnv(functions, autoreset_mode=mode), 160, space) >= 9


@pytest.mark.parametrize("mode", MODES)
@settings(max_examples=30, deadline=None)
@given(lengths=st.lists(st.lists(st.integers(1, 5), min_size=1, max_size=3), min_size=1, max_size=4))
def test_it_is_the_dummy_whatever_ends_when(mode, lengths):
    functions = [lambda each=each: Counts(each) for each in lengths]
    assert compare(functions, SyncVectorEnv(functions, autoreset_mode=mode), 14, Counts.action_space) > 0


@pytest.mark.parametrize("mode", MODES)
def test_processes_too(mode):
    functions = [lambda: Counts([3, 4]), lambda: Counts([2])]
    assert compare(functions, AsyncVectorEnv(functions, autoreset_mode=mode), 12, Counts.action_space) > 4


def test_processes_that_would_reset_twice_are_refused():
    functions = [lambda: Counts([3, 4]), lambda: Counts([2])]
    vector = AsyncVectorEnv(functions, shared_memory=False)
    with pytest.raises(ValueError, match=r"resets twice: .*SAME_STEP"):
        GymnasiumVecEnv(vector)
    vector.close()
    vector = AsyncVectorEnv(functions, shared_memory=False, autoreset_mode=AutoresetMode.SAME_STEP)
    assert compare(functions, vector, 12, Counts.action_space) > 4


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("copy", [True, False])
def test_no_transition_crosses_episodes(mode, copy):
    """
    A step that only resets would be a transition with reward 0 from the last observation to the first.

    Without copies, every step writes into the same memory: stored observations must be those from before it.
    """
    env = VecMonitor(GymnasiumVecEnv(SyncVectorEnv([lambda: Counts([3])] * 2, copy=copy, autoreset_mode=mode)))
    model = TDC("MultiInputPolicy", env, learning_starts=1000, buffer_size=200, seed=0, device="cpu").learn(60)
    buffer = model.replay_buffer
    now, then = buffer.observations, buffer.next_observations
    filled = slice(0, buffer.pos)
    np.testing.assert_array_equal(now["episode"][filled], then["episode"][filled])
    np.testing.assert_array_equal(now["step"][filled] + 1, then["step"][filled])
    assert (buffer.timeouts[filled].sum(), buffer.dones[filled].sum()) == (10, 20)  # every second episode is truncated
    assert [info["l"] for info in model.ep_info_buffer] == [3] * 20


class Tensors(VectorEnv):
    """A simulator on tensors that resets in the step that ends an episode; its environments have no attributes."""

    metadata: ClassVar[dict] = {"autoreset_mode": AutoresetMode.SAME_STEP}
    render_mode = None

    def __init__(self, num_envs=4):
        self.num_envs = num_envs
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.single_action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        self.t = th.arange(self.num_envs)
        self.observations = th.empty(self.num_envs, 2)
        return self._observe(), {}

    def _observe(self):
        return self.observations.copy_(th.stack([self.t, self.t], dim=1))  # in place, as simulators do

    def step(self, actions):
        self.t = self.t + 1
        over, last = self.t >= 6, self._observe().clone()
        self.t = th.where(over, 0, self.t)
        infos = {"final_obs": last, "_final_obs": over} if over.any() else {}
        return self._observe(), th.ones(self.num_envs), th.zeros(self.num_envs, dtype=th.bool), over, infos


class Together(VectorEnv):
    """As Gymnasium's JAX environments: one number as the seed, and all reset together in the step after the end."""

    render_mode = None

    def __init__(self, num_envs=3):
        self.num_envs, self.seeds, self.over = num_envs, [], False
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.single_action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
        self.episode = self.t = 0

    def _begin(self):
        self.t, self.episode = 0, self.episode + 1

    def _observe(self):
        return np.float32([[self.episode, self.t]] * self.num_envs)

    def reset(self, *, seed=None, options=None):
        assert seed is None or type(seed) is int
        self.seeds.append(seed)
        self._begin()
        return self._observe(), {}

    def step(self, actions):
        self.t += 1
        if self.over:
            self._begin()
        self.over = self.t == 4
        false, over = np.zeros(self.num_envs, bool), np.full(self.num_envs, self.over)
        return self._observe(), np.full(self.num_envs, float(self.t)), false, over, {}


class Reach(gym.Env):
    """The goal is 1; the action moves towards it or away."""

    observation_space = gym.spaces.Dict(
        dict.fromkeys(("observation", "achieved_goal", "desired_goal"), gym.spaces.Box(-9, 9, (1,), np.float32))
    )
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    n_calls = 0

    def _observe(self):
        return {"observation": self.x, "achieved_goal": self.x, "desired_goal": np.float32([1])}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = np.float32([0])
        return self._observe(), {}

    def step(self, action):
        self.x = np.clip(self.x + action, -9, 9).astype(np.float32)
        return self._observe(), float(self.compute_reward(self.x, 1.0, {})), False, False, {}

    def compute_reward(self, achieved, desired, info):
        Reach.n_calls += np.ndim(achieved) == 2  # a batch of the replay buffer
        return -np.abs(achieved - desired).sum(axis=-1)


HINDSIGHT = ["policy:MultiInputPolicy", "replay_buffer_class:stable_baselines3.HerReplayBuffer", "n_envs:2"]


def test_hindsight_asks_one_of_the_environments(tmp_path):
    gym.register("Reach-v0", Reach, max_episode_steps=10)
    argv = ["--env", "Reach-v0", "-n", "60", "--vec-env", "gymnasium", "--eval-freq", "0", "-f", str(tmp_path)]
    networks = ["policy_kwargs:{net_arch: [8]}", "learning_starts:40", "batch_size:8", "buffer_size:200"]
    Reach.n_calls = 0
    assert train.main([*argv, "--device", "cpu", "-params", *HINDSIGHT, *networks]) == 0
    assert Reach.n_calls == 10  # (60 − 40)/2 steps of both: each has one update with one call


@pytest.mark.parametrize("n_envs", [1, 2])
def test_hindsight_without_single_environments_is_refused_before_the_first_step(n_envs):
    vector = Tensors(n_envs)
    vector.single_observation_space = Reach.observation_space
    hyperparams = parse({"n_timesteps": 10, **dict(line.split(":") for line in HINDSIGHT[:2])}, TDC, "a file")
    with pytest.raises(ValueError, match=r"HerReplayBuffer calls compute_reward of single .*, and Tensors.* has none"):
        make_model("tdc", hyperparams, VecMonitor(GymnasiumVecEnv(vector)))


def test_environments_that_take_one_seed_and_reset_together():
    env = GymnasiumVecEnv(Together())
    env.seed(7)
    seen = [env.reset()[1].tolist()]
    for _ in range(9):
        observations, rewards, dones, infos = env.step(np.zeros((3, 1), np.float32))
        assert rewards[0] > 0  # the step that only resets, with reward 0, is hidden
        seen.append(observations[1].tolist())
        assert dones[0] == (seen[-1][1] == 0)
        if dones[0]:
            assert infos[2]["terminal_observation"].tolist() == [seen[-2][0], 4]
    assert env.env.seeds == [7]
    assert seen == [[1, t] for t in range(4)] + [[2, t] for t in range(4)] + [[3, t] for t in range(2)]


def test_a_run_in_a_vector_environment_is_played_in_one(tmp_path, capsys):
    """No single environment has this id."""
    gym.register("Together-v0", vector_entry_point="tests.envs.test_vector:Together")
    options = ["--eval-freq", "150", "--eval-episodes", "1", "--device", "cpu", "-f", str(tmp_path), "-n", "200"]
    argv = ["--env", "Together-v0", *options, *SMALL_3]
    assert train.main([*argv, "--vec-env", "gymnasium"]) == 0
    assert enjoy.main([str(tmp_path / "tdc" / "Together-v0_1"), "--n-episodes", "2"]) == 0
    assert "Return: 10.00 ± 0.00" in capsys.readouterr().out  # 1 + 2 + 3 + 4
    with pytest.raises(SystemExit):
        train.main(argv)
    assert "Together-v0 is a vector environment: add --vec-env gymnasium" in capsys.readouterr().err


def test_tensors_become_arrays():
    env = GymnasiumVecEnv(Tensors())
    assert env.reset().tolist() == [[0, 0], [1, 1], [2, 2], [3, 3]]
    for _ in range(3):
        observations, rewards, dones, infos = env.step(np.zeros((4, 1), np.float32))
    assert (observations.dtype, rewards.dtype, dones.tolist()) == (np.float32, np.float32, [False, False, False, True])
    assert observations[3].tolist() == [0, 0]
    assert infos[3]["terminal_observation"].tolist() == [6, 6]
    assert infos[3]["TimeLimit.truncated"] is True
    assert infos[0] == {}
    buffer = TDC("MlpPolicy", env, learning_starts=20, batch_size=8, device="cpu").learn(60).replay_buffer
    filled = slice(0, buffer.pos)
    np.testing.assert_array_equal(buffer.observations[filled] + 1, buffer.next_observations[filled])


def test_attributes_and_methods():
    env = GymnasiumVecEnv(SyncVectorEnv([lambda: Counts([3]), lambda: Counts([4])]))
    assert env.get_attr("lengths") == [[3], [4]]
    assert env.get_attr("lengths", 1) == [[4]]
    env.reset()
    env.set_attr("episode", 7)
    assert env.get_attr("episode") == [7, 7]
    assert [step["step"].tolist() for step in env.env_method("_observe")] == [[0], [0]]
    assert env.env_is_wrapped(gym.wrappers.TimeLimit) == [False, False]
    env.set_attr("episode", [8, 9], indices=0)  # a list is a value like any other
    assert env.get_attr("episode") == [[8, 9], 7]
    env.set_attr("episode", 5, indices=0)
    assert [step["episode"].tolist() for step in env.env_method("_observe", indices=[1, 0])] == [[7], [5]]
    tensors = GymnasiumVecEnv(Tensors())
    for call in (lambda: tensors.set_attr("t", 1, indices=0), lambda: tensors.env_method("_observe", indices=[1])):
        with pytest.raises(ValueError, match=r"of Tensors.* is for all environments at once"):
            call()
    with pytest.raises(AttributeError, match="cannot set attributes"):
        tensors.set_attr("gravity", 1)
    with pytest.raises(AttributeError, match="cannot call methods"):
        tensors.env_method("jump")


class ResetsAll(SyncVectorEnv):
    """Ignores ``reset_mask``, as Gymnasium 1.0 does."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)


def test_an_environment_that_resets_all_or_none_is_refused():
    env = GymnasiumVecEnv(ResetsAll([lambda: Counts([2]), lambda: Counts([9])]))
    env.reset()
    env.step(np.zeros((2, 1), np.float32))
    with pytest.raises(ValueError, match=r"cannot reset single environments .*SAME_STEP"):
        env.step(np.zeros((2, 1), np.float32))


def test_infos_are_split_by_hand():
    infos = {"a": np.array([1, 2]), "_a": np.array([True, False]), "b": {"c": np.array([3.0, 4.0])}, "_own": ["x", "y"]}
    assert split_infos(infos, 2) == [{"a": 1, "b": {"c": 3}, "_own": "x"}, {"b": {"c": 4}, "_own": "y"}]


SMALL_3 = [*SMALL, "n_envs:3"]


def train_on(folder, *args):
    argv = ["--env", "Hopper-v4", "-n", "450", "--seed", "1", "--vec-env", "gymnasium", "--eval-freq", "150"]
    argv += ["--eval-episodes", "1", "--device", "cpu", "--resume-freq", "40", "-f", folder, *args]
    return train.main([*map(str, argv), *SMALL_3, "buffer_size:1000", "gradient_steps:3"])


def test_a_training_with_it_resumes_exactly(tmp_path, monkeypatch):
    assert train_on(tmp_path / "whole") == 0

    class Killed(BaseException):
        pass

    def die_at_300(self, step):
        if step > 300:
            raise Killed
        own(self, step)

    own = ResumeCallback._write
    monkeypatch.setattr(ResumeCallback, "_write", die_at_300)
    with pytest.raises(Killed):
        train_on(tmp_path / "stopped")
    monkeypatch.undo()
    folder = tmp_path / "stopped" / "tdc" / "Hopper-v4_1"
    assert train.main(["--resume", str(folder)]) == 0
    whole, resumed = (tmp_path / name / "tdc" / "Hopper-v4_1" for name in ("whole", "stopped"))
    models = [TDC.load(path / "Hopper-v4.zip", device="cpu") for path in (whole, resumed)]
    for one, other in zip(*(model.policy.parameters() for model in models), strict=True):
        assert th.equal(one, other)
    rows = [(path / "0.monitor.csv").read_text().splitlines()[2:] for path in (whole, resumed)]
    assert [row.rpartition(",")[0] for row in rows[0]] == [row.rpartition(",")[0] for row in rows[1]]
    assert len(rows[0]) > 10


class Locked(Tensors):
    """Holds a lock, whose state Python cannot read."""

    def __init__(self):
        super().__init__()
        self.lock = threading.Lock()


def test_environments_that_cannot_be_captured_begin_new_episodes(tmp_path):
    def learn(steps):
        states = ResumeCallback(tmp_path / "resume", freq=20)
        model = TDC("MlpPolicy", GymnasiumVecEnv(Locked()), learning_starts=1000, buffer_size=400, seed=0, device="cpu")
        states.select(model)
        with pytest.warns(RuntimeWarning, match="lock") as caught:
            model.learn(steps, callback=states)
        states.store.close()
        return model, " ".join(str(each.message) for each in caught)

    learn(48)
    model, said = learn(96)
    assert "Continuing with new episodes" in said
    buffer = model.replay_buffer
    first = np.flatnonzero((buffer.observations[: buffer.pos, 0] == 0).all(axis=1))
    ended = buffer.dones[first - 1, 0]  # an episode ended before each first observation, even at the interruption
    assert ended[first > 0].all()


def test_an_info_of_all_environments_is_every_environment_s():
    """As returned by simulators that keep one log for all their environments."""
    infos = {"log": {"return": 0.5}, "steps": np.array([1, 2, 3]), "name": "abc"}
    expected = [{"log": {"return": 0.5}, "steps": i, "name": "abc"} for i in (1, 2, 3)]
    assert split_infos(infos, 3) == expected
