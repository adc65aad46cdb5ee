"""Self-calibrating λ: its direction, its units, which errors count, and how it is saved and continued."""

import math
import re

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tdc import NonFiniteError, load_safely
from sb3_tdc.ablations import calibration
from sb3_tdc.ablations.calibration import (
    MAX_LAM,
    CalibratedTDC,
    Calibration,
    calibrate,
    updates_before,
)
from sb3_tdc.critics.episodes import Steps
from sb3_tdc.critics.returns import discounted_returns, known_steps
from sb3_tdc.resume.run_state import _restart_episodes as restart_episodes
from tests.helpers.tdc import HEADS, TwoActions, make

errors = arrays(np.float64, 5, elements=st.floats(-100, 100, width=32))


@pytest.fixture
def short_period(monkeypatch):
    monkeypatch.setattr(calibration, "PERIOD", 20)


def make_fast(env=None, **kwargs):
    """Make a model whose calibration begins after two updates, unless ``tau`` or ``gamma`` is given."""
    return make(env or TwoActions(), algorithm=CalibratedTDC, **{"tau": 1.0, "gamma": 0.5, **kwargs})


# ---------------------------------------------------------------- the rule


def test_one_step_by_hand():
    # The first errors set the scale to their mean size, (|4| + |−2|)/2 = 3; λ rises by 0.1 · 1/3
    lam, scale = calibrate(1.0, 0.0, np.array([4.0, -2.0]), 0.0)
    assert (lam, scale) == (pytest.approx(1 + 0.1 / 3), 3)
    # Then the scale moves a twentieth of the way from 3 to 1, to 2.9; λ falls by 0.1/2.9
    lam, scale = calibrate(lam, scale, np.array([-1.0]), 0.0)
    assert scale == pytest.approx(2.9)
    assert lam == pytest.approx(1 + 0.1 / 3 - 0.1 / 2.9)
    # An error of many times the scale moves λ by no more than 0.1
    assert calibrate(1.0, 0.01, np.array([50.0]), 0.0)[0] == pytest.approx(1.1)


@given(errors, st.floats(0, MAX_LAM), st.floats(0, 10))
def test_underestimation_raises_lam_and_overestimation_lowers_it(errors, lam, scale):
    new, _ = calibrate(lam, scale, errors, 0.0)
    assert 0 <= new <= MAX_LAM
    assert abs(new - lam) <= 0.1 + 1e-12
    assert (new - lam) * errors.mean() >= 0


@given(errors, st.floats(0.1, 10), st.floats(0.01, 1000))
def test_the_scale_of_rewards_does_not_matter(errors, scale, factor):
    expected, size = calibrate(1.0, scale, errors, 0.0)
    found, larger = calibrate(1.0, factor * scale, factor * errors, 0.0)
    assert (found, larger) == (pytest.approx(expected), pytest.approx(factor * size))


def test_no_error_is_no_division():
    assert calibrate(1.0, 0.0, np.zeros(3), 0.0) == (1.0, 0.0)


@pytest.mark.parametrize("lam", [0.0, 0.5, 10.0])
def test_where_it_begins(lam):
    model = make_fast(lam=lam)
    assert (model.scheduled("lam"), model.calibrated) == (lam, lam)


@pytest.mark.parametrize(
    ("lam", "message"),
    [
        (-0.1, "lam must be a finite number of at least 0.0, got -0.1"),
        (10.1, "lam must be a finite number between 0.0 and 10.0, got 10.1"),
        (math.nan, "lam must be a finite number of at least 0.0, got nan"),
        ("auto", "lam must be a finite number of at least 0.0, got 'auto'"),
        (lambda progress: 1.0, "lam must be a number, at which the calibration begins, got a schedule"),
    ],
)
def test_it_begins_at_a_number_up_to_10(lam, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        make_fast(lam=lam)


def test_lam_is_never_negative():
    model = make_fast(lam=0.05).learn(10)
    for _ in range(2):
        model._calibrate(np.array([-1.0]))
        assert model.calibrated == model.scheduled("lam") == 0


def test_it_waits_until_values_can_have_their_size():
    assert updates_before(tau=0.005, gamma=0.99) == pytest.approx(20_000)
    assert updates_before(tau=1.0, gamma=0.0) == 1
    assert updates_before(tau=0.5, gamma=1.0) == 2_000
    assert updates_before(tau=0.0, gamma=0.9) == math.inf


# ---------------------------------------------------------------- which errors count


def test_returns_of_an_episode_by_hand():
    episode = Steps(calibration.EVERY)
    for step in range(25):
        episode.add(np.array([step]), np.array([0.0]), float(step == 24))
    assert [int(o[0]) for o in episode.observations] == [0, 10, 20]
    assert discounted_returns(episode.rewards, 0.5)[::10].tolist() == [0.5**24, 0.5**14, 0.5**4]
    assert discounted_returns(episode.rewards, 0.5, 6.0)[::10].tolist() == [4 * 0.5**24, 4 * 0.5**14, 4 * 0.5**4]


def test_it_waits_for_steps_and_for_updates():
    pending = Calibration(n_updates=100)
    pending.begin_episodes(2)
    for _ in range(600):
        pending.episodes[0].add(np.zeros(1), np.zeros(1), 1.0)
        pending.episodes[1].add(np.zeros(1), np.zeros(1), 1.0)
    pending.end_episode(0, np.array([1.0, 2.0]))
    assert pending.take_errors(5_000) is None  # 600 steps
    pending.end_episode(1, np.array([3.0]))
    assert pending.take_errors(1_099) is None
    assert pending.take_errors(1_100).tolist() == [1, 2, 3]
    assert pending.take_errors(5_000) is None  # each error counts once
    assert pending.episodes[0].rewards == []
    pending.end_episode(0, None)
    assert pending.errors == []


def test_of_thousands_of_environments_some_are_followed():
    pending = Calibration()
    pending.begin_episodes(4096)
    followed = list(pending.episodes)
    assert (len(followed), followed[0], followed[-1]) == (16, 0, 4095)
    assert np.ptp(np.diff(followed)) <= 1
    pending.begin_episodes(3)
    assert list(pending.episodes) == [0, 1, 2]


GAMMA, HAZARD, LIMIT = 0.95, 0.01, 150


def play(rng):
    """
    Play an episode with reward 1 at every step, which terminates with the same probability after each.

    :return: the rewards, and whether the episode terminated
    """
    length = rng.geometric(HAZARD)
    return np.ones(min(length, LIMIT)), length <= LIMIT


def test_an_exact_critic_is_left_alone_though_time_limits_end_the_good_episodes():
    rng = np.random.default_rng(0)
    value = 1 / (1 - GAMMA * (1 - HAZARD))
    with_values, known = [], []
    for rewards, terminated in (play(rng) for _ in range(4_000)):
        episode = Steps(calibration.EVERY)
        for reward in rewards:
            episode.add(np.zeros(1), np.zeros(1), reward)
        with_values.append(discounted_returns(rewards, GAMMA, 0.0 if terminated else value)[:: episode.every])
        n_known = known_steps(len(rewards), terminated, GAMMA, LIMIT)
        known.append(discounted_returns(rewards, GAMMA)[:n_known])
    assert np.concatenate(with_values).mean() == pytest.approx(value, rel=0.01)
    assert np.concatenate(known).mean() == pytest.approx(value, rel=0.01)


class Recorded(TwoActions):
    """Records what the slow reference needs: observations, actions, rewards, and how each episode ended."""

    def reset(self, **kwargs):
        observation, info = super().reset(**kwargs)
        self.trajectory = {"observations": [observation], "actions": [], "rewards": []}
        return observation, info

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        for name, value in (("observations", observation), ("actions", action), ("rewards", reward)):
            self.trajectory[name].append(value)
        if terminated or truncated:
            self.log.append((self.trajectory, terminated))
        return observation, reward, terminated, truncated, info


def reference_errors(model, normalization, trajectory, terminated):
    """Return G − Q₁ in float64, computed step by step."""
    observations = [normalization.normalize_obs(o[None]) for o in trajectory["observations"]]
    scaled = [model.policy.scale_action(action) for action in trajectory["actions"]]
    scaled.append(model.policy.scale_action(model.predict(observations[-1], deterministic=True)[0][0]))

    def value(step):
        with th.no_grad():
            inputs = th.tensor(observations[step]), th.tensor(scaled[step][None], dtype=th.float32)
            return model.critic(*inputs)[0, 0].double().mean().item()

    following = 0.0 if terminated else value(-1)
    found = []
    for step in reversed(range(len(trajectory["rewards"]))):
        reward = np.clip(trajectory["rewards"][step] / np.sqrt(normalization.ret_rms.var + 1e-8), -10, 10)
        following = reward + model.gamma * following
        found.append(following - value(step))
    return found[::-1][:: calibration.EVERY]


@HEADS
@pytest.mark.parametrize("timeouts_count", [True, False])
def test_errors_are_those_of_a_slow_reference(monkeypatch, short_period, stochastic_actor, timeouts_count):
    """Two environments, terminated and truncated episodes, normalised observations and rewards; nothing is learned."""
    monkeypatch.setattr(calibration, "EVERY", 2)
    logs = [[], []]

    def make_env(i):
        env = Recorded()
        env.log = logs[i]
        env.episode = i - 1  # one environment's first episode is truncated, the other's terminates
        return env

    numbers = iter((0, 1))
    vector = VecNormalize(make_vec_env(lambda: make_env(next(numbers)), 2), training=False)
    vector.obs_rms.mean, vector.obs_rms.var, vector.ret_rms.var = np.full(3, 0.3), np.full(3, 2.0), np.float64(9.0)
    model = make_fast(
        vector, stochastic_actor=stochastic_actor, learning_rate=0.0, qf_learning_rate=0.0, gamma=0.9,
        replay_buffer_kwargs={"handle_timeout_termination": timeouts_count},
    )  # fmt: skip
    ended, end = [], Calibration.end_episode

    def spy(self, env, errors):
        ended.append((env, len(self.episodes[env].rewards), errors))
        end(self, env, errors)

    monkeypatch.setattr(Calibration, "end_episode", spy)
    model.learn(200)
    assert len(ended) > 20
    for i, log in enumerate(logs):
        of_env = [(length, errors) for env, length, errors in ended if env == i]
        for (trajectory, terminated), (length, errors) in zip(log, of_env, strict=True):
            assert length == len(trajectory["rewards"])
            if errors is not None:
                expected = reference_errors(model, vector, trajectory, terminated or not timeouts_count)
                np.testing.assert_allclose(errors, expected, rtol=1e-4, atol=1e-5)
    assert {length for _, length, errors in ended if errors is not None} == {5, 7}
    assert sum(errors is None for *_, errors in ended) >= 8  # during the warm-up and the first ten updates


# ---------------------------------------------------------------- in training


class Pays(TwoActions):
    """Pays a reward that the critics cannot predict at first: λ has to rise or fall."""

    reward = 0.0

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, self.reward, *rest


@pytest.mark.parametrize(("reward", "rises"), [(100.0, True), (-100.0, False)])
def test_it_follows_the_sign_of_the_error(short_period, reward, rises):
    env = Pays()
    env.reward = reward
    model = make_fast(env, qf_learning_rate=1e-6, gamma=0.3).learn(400)
    assert (model.scheduled("lam") > 1) is rises
    assert model.logger.name_to_value["train/lam"] == model.scheduled("lam")
    assert (model.logger.name_to_value["train/lam_error"] > 0) is rises


def test_it_works_where_time_limits_are_short(monkeypatch):
    monkeypatch.setattr(calibration, "PERIOD", 200)
    model = make(algorithm=CalibratedTDC, tau=1.0, gamma=0.9, qf_learning_rate=0.0).learn(700)  # Pendulum: 200 steps
    assert model.scheduled("lam") < 1  # the critics stay near 0, but all rewards are negative


@HEADS
@pytest.mark.parametrize("n_envs", [1, 3])
def test_both_paths_calibrate_alike(short_period, stochastic_actor, n_envs):
    lams = []
    for fused in (False, True):
        env = make_vec_env(TwoActions, n_envs, seed=1)
        model = make_fast(env, lam=0.5, fused=fused, stochastic_actor=stochastic_actor).learn(300)
        lams.append(model.scheduled("lam"))
    assert lams[0] != 0.5
    assert lams[0] == pytest.approx(lams[1], abs=1e-3)


def test_errors_are_in_the_critics_units(short_period):
    """Rewards 1000 times as large lead to the same λ once they are normalised."""
    lams = []
    for factor in (1.0, 1000.0):
        env = VecNormalize(
            make_vec_env(lambda factor=factor: gym.wrappers.TransformReward(TwoActions(), lambda r: factor * r), 1)
        )
        env.seed(0)
        lams.append(make_fast(env).learn(300).scheduled("lam"))
    assert lams[0] != 1
    assert lams[0] == pytest.approx(lams[1], abs=1e-3)


class Scalar(TwoActions):
    action_space = gym.spaces.Box(-1.0, 1.0, (), np.float32)


@pytest.mark.filterwarnings("ignore")
def test_actions_without_axes(short_period):
    assert make_fast(Scalar()).learn(200).scheduled("lam") != 1


# ---------------------------------------------------------------- saving and continuing


def test_a_reward_that_is_not_finite_calibrates_nothing(tmp_path, monkeypatch):
    class Broken(TwoActions):
        def step(self, action):
            observation, reward, terminated, truncated, info = super().step(action)
            return observation, np.nan if terminated else reward, terminated, truncated, info

    monkeypatch.setattr(calibration, "PERIOD", 7)
    model = make_fast(Broken(), learning_starts=1)
    with pytest.raises(NonFiniteError, match=r"environment returned a non-finite reward .* at timestep 12"):
        model.learn(20)
    assert (model.calibrated, model.error_scale) == (model.lam, 0.0)
    model.save(tmp_path / "model")
    loaded = load_safely(tmp_path / "model", algorithm=CalibratedTDC, device="cpu")
    assert loaded.calibrated == model.lam


def test_it_is_saved_and_continues(tmp_path, short_period):
    model = make_fast().learn(200)
    value = model.scheduled("lam")
    assert value != 1
    model.save(tmp_path / "model.zip")
    opened = (
        CalibratedTDC.load(tmp_path / "model.zip"),
        load_safely(tmp_path / "model.zip", algorithm=CalibratedTDC, device="cpu"),
    )
    for loaded in opened:
        assert (loaded.lam, loaded.scheduled("lam"), loaded.error_scale) == (1.0, value, model.error_scale)
        loaded.set_env(make_vec_env(TwoActions, 1))
        loaded.learn(100, reset_num_timesteps=False)
        assert loaded.scheduled("lam") != value


def test_another_start_begins_anew(tmp_path, short_period):
    model = make_fast().learn(200)
    model.save(tmp_path / "model.zip")
    loaded = CalibratedTDC.load(tmp_path / "model.zip", env=TwoActions(), lam=0.2)
    assert (loaded.scheduled("lam"), loaded.error_scale) == (0.2, 0.0)
    loaded.learn(100, reset_num_timesteps=False)
    assert 0 <= loaded.scheduled("lam") < 0.9
    model.lam = 3.0
    assert model.scheduled("lam") == 3


@pytest.mark.parametrize("field", ["_calibrated", "_calibrated_from"])
def test_a_crafted_file_has_no_larger_lam(tmp_path, field):
    model = make_fast()
    vars(model)[field] = 1e300
    model.save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=rf"{field} must be a finite number from 0 to 10, got 1e\+300"):
        load_safely(tmp_path / "model.zip", algorithm=CalibratedTDC)


def lengths_of_episodes(monkeypatch):
    lengths, end = [], Calibration.end_episode

    def spy(self, env, errors):
        lengths.append(len(self.episodes[env].rewards))
        end(self, env, errors)

    monkeypatch.setattr(Calibration, "end_episode", spy)
    return lengths


def test_episodes_go_on_from_one_learn_to_the_next(monkeypatch):
    lengths = lengths_of_episodes(monkeypatch)
    model = make_fast()
    for _ in range(20):
        model.learn(3, reset_num_timesteps=False)
    assert lengths == [5, 7] * 5


def test_a_step_that_a_callback_loses_is_not_joined_with_what_follows(monkeypatch):
    lengths = lengths_of_episodes(monkeypatch)
    model = make_fast()
    model.learn(100, callback=StopTrainingOnMaxEpisodes(3, verbose=0))
    model.learn(40, reset_num_timesteps=False)
    assert set(lengths) == {5, 7}


def test_episodes_that_start_again_are_new(monkeypatch):
    lengths = lengths_of_episodes(monkeypatch)
    model = make_fast().learn(53)  # 4 × (5 + 7) steps, then an episode of 5
    model.learn(3, reset_num_timesteps=False)
    restart_episodes(model)
    assert [episode.rewards for episode in model._calibration.episodes.values()] == [[]]
    model.learn(30, reset_num_timesteps=False)
    assert set(lengths) == {5, 7}


def test_without_a_reset_the_next_episodes_are_followed_too(tmp_path, short_period):
    model = make_fast().learn(100)
    model.save(tmp_path / "model.zip")
    loaded = CalibratedTDC.load(tmp_path / "model.zip", env=make_vec_env(TwoActions, 1), force_reset=False)
    value = loaded.scheduled("lam")
    loaded.env.reset()
    loaded.learn(100, reset_num_timesteps=False)
    assert loaded.scheduled("lam") != value


def test_calibrating_changes_nothing_else(short_period):
    """With λ reset after every calibration, the weights equal those of plain TDC with this λ."""

    def calibrate_and_put_back(errors):
        CalibratedTDC._calibrate(held, errors)
        calibrated.append(held.calibrated)
        held._calibrated = 0.5

    calibrated = []
    plain = make(TwoActions(), tau=1.0, gamma=0.5, lam=0.5, seed=3).learn(150)
    held = make_fast(lam=0.5, seed=3)
    held._calibrate = calibrate_and_put_back
    held.learn(150)
    assert set(calibrated) - {0.5}
    for one, other in zip(plain.policy.parameters(), held.policy.parameters(), strict=True):
        assert th.equal(one, other)
