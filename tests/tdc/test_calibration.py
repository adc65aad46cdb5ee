"""λ that tunes itself: the direction, the units, and that it survives stopping."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tdc import TDC, load_safely
from sb3_tdc.tdc.lam import MAX_LAM, PendingEpisode, calibrate, initial_lam
from tests.helpers.tdc import HEADS, TwoActions, make

errors = arrays(np.float64, 5, elements=st.floats(-100, 100, width=32))


def test_one_step_by_hand():
    # The first episode sets the scale, |4| and |−2| on average: 3; λ moves by 0.1 · 500/1000 · 1/3
    lam, scale = calibrate(1.0, 0.0, np.array([4.0, -2.0]), 500)
    assert (lam, scale) == (pytest.approx(1 + 0.05 / 3), 3)
    # 1,000 steps later the scale has moved by a twentieth of the way from 3 to 1, to 2.9; λ falls by 0.1/2.9
    lam, scale = calibrate(lam, scale, np.array([-1.0]), 1_000)
    assert scale == pytest.approx(2.9)
    assert lam == pytest.approx(1 + 0.05 / 3 - 0.1 / 2.9)


@given(errors, st.floats(0, MAX_LAM), st.floats(0, 10), st.integers(1, 5_000))
def test_underestimation_raises_lam_and_overestimation_lowers_it(errors, lam, scale, n_steps):
    new, _ = calibrate(lam, scale, errors, n_steps)
    assert 0 <= new <= MAX_LAM
    assert (new - lam) * errors.mean() >= 0


@given(errors, st.floats(0.1, 10), st.integers(1, 5_000), st.floats(0.01, 1000))
def test_the_scale_of_rewards_does_not_matter(errors, scale, n_steps, factor):
    expected, size = calibrate(1.0, scale, errors, n_steps)
    found, larger = calibrate(1.0, factor * scale, factor * errors, n_steps)
    assert (found, larger) == (pytest.approx(expected), pytest.approx(factor * size))


def test_no_error_is_no_division():
    assert calibrate(1.0, 0.0, np.zeros(3), 10) == (1.0, 0.0)


@pytest.mark.parametrize(("text", "expected"), [("auto", 1), ("auto_0.5", 0.5), ("auto_0", 0)])
def test_where_it_begins(text, expected):
    assert initial_lam(text) == expected
    assert make(lam=text).scheduled("lam") == expected


@pytest.mark.parametrize("text", ["automatic", "auto_-1", "auto_nan", "auto_11", "high"])
def test_other_texts_are_refused(text):
    with pytest.raises(ValueError, match="lam must be"):
        make(lam=text)


def test_returns_of_an_episode_by_hand():
    episode = PendingEpisode()
    for step in range(25):
        episode.add(np.array([step]), np.array([0.0]), float(step == 24))
    returns, n_steps = episode.finish(episode.rewards, terminated=True, gamma=0.5)
    assert [int(o[0]) for o in episode.observations] == [0, 10, 20]
    assert returns.tolist() == [0.5**24, 0.5**14, 0.5**4]
    assert n_steps == 25
    returns, n_steps = episode.finish(episode.rewards, terminated=False, gamma=0.5)  # 0.5⁷ < 1 %: 18 steps are known
    assert (len(returns), n_steps) == (2, 18)


class Pays(TwoActions):
    """A reward that critics cannot have predicted in the beginning: λ has to go up, or down."""

    reward = 0.0

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, self.reward, *rest


@pytest.mark.parametrize(("reward", "rises"), [(100.0, True), (-100.0, False)])
def test_it_follows_the_sign_of_the_error(reward, rises):
    env = Pays()
    env.reward = reward
    model = make(env, lam="auto", qf_learning_rate=1e-6, gamma=0.3).learn(400)
    assert (model.scheduled("lam") > 1) is rises
    assert model.logger.name_to_value["train/lam"] == model.scheduled("lam")


@HEADS
@pytest.mark.parametrize("n_envs", [1, 3])
def test_both_paths_calibrate_alike(stochastic_actor, n_envs):
    lams = []
    for fused in (False, True):
        env = make_vec_env(TwoActions, n_envs, seed=1)
        model = make(env, lam="auto_0.5", fused=fused, stochastic_actor=stochastic_actor, gamma=0.5).learn(300)
        lams.append(model.scheduled("lam"))
    assert lams[0] != 0.5
    assert lams[0] == pytest.approx(lams[1], abs=1e-3)


def test_errors_are_in_the_critics_units():
    """With normalised rewards of 1000 times the size, λ is the same."""
    lams = []
    for factor in (1.0, 1000.0):
        env = VecNormalize(
            make_vec_env(lambda factor=factor: gym.wrappers.TransformReward(TwoActions(), lambda r: factor * r), 1)
        )
        env.seed(0)
        lams.append(make(env, lam="auto", gamma=0.5).learn(300).scheduled("lam"))
    assert lams[0] != 1
    assert lams[0] == pytest.approx(lams[1], abs=1e-3)


def test_it_is_saved_and_continues(tmp_path):
    model = make(TwoActions(), lam="auto", gamma=0.5).learn(200)
    value = model.scheduled("lam")
    assert value != 1
    model.save(tmp_path / "model.zip")
    for loaded in (TDC.load(tmp_path / "model.zip"), load_safely(tmp_path / "model.zip", device="cpu")):
        assert (loaded.lam, loaded.scheduled("lam"), loaded._lam_scale) == ("auto", value, model._lam_scale)
        loaded.set_env(make_vec_env(TwoActions, 1))
        loaded.learn(100, reset_num_timesteps=False)
        assert loaded.scheduled("lam") != value


def test_calibrating_changes_nothing_else():
    """λ is put back after every calibration: the same weights as with this λ."""

    def calibrate_and_put_back(episode, terminated):
        TDC._calibrate_lam(held, episode, terminated)
        calibrated.append(held._lam_value)
        held._lam_value = 0.5

    calibrated = []
    plain = make(TwoActions(), lam=0.5, gamma=0.5, seed=3).learn(150)
    held = make(TwoActions(), lam="auto_0.5", gamma=0.5, seed=3)
    held._calibrate_lam = calibrate_and_put_back
    held.learn(150)
    assert set(calibrated) - {None, 0.5}
    for one, other in zip(plain.policy.parameters(), held.policy.parameters(), strict=True):
        assert th.equal(one, other)
