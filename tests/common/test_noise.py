"""Noise drawn for many environments at once equals what SB3 draws for one after the other."""

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise

from sb3_tdc import MEOW, TDC, load_safely
from sb3_tdc.advb import AdvBSAC, AdvBTD3, AdvBTDC
from sb3_tdc.common.noise import NormalNoiseRange, VectorizedNormalNoise, noise_of_all
from tests.helpers.tdc import TwoActions


@given(n_envs=st.integers(2, 40), n_actions=st.integers(1, 7), seed=st.integers(0, 1000), before=st.integers(0, 1))
def test_one_draw_is_the_draws_of_sb3(n_envs, n_actions, seed, before):
    one = NormalActionNoise(np.linspace(-1, 1, n_actions), np.linspace(0.1, 2, n_actions))
    drawn = []
    for noise in (VectorizedActionNoise(one, n_envs), VectorizedNormalNoise(one, n_envs)):
        np.random.seed(seed)
        np.random.normal(size=before)  # NumPy keeps every second normal number for the next call
        drawn.append([noise(), noise(), np.random.normal()])
    for expected, found in zip(*drawn, strict=True):
        np.testing.assert_array_equal(found, expected)
        assert np.asarray(found).dtype == np.asarray(expected).dtype


def test_a_range_is_evenly_spaced_over_the_environments():
    noise = noise_of_all(NormalNoiseRange(np.zeros(2), np.full(2, 0.1), np.full(2, 0.4)), 4)
    np.testing.assert_allclose([each._sigma for each in noise.noises], [[0.1] * 2, [0.2] * 2, [0.3] * 2, [0.4] * 2])
    np.random.seed(0)
    drawn = np.stack([noise() for _ in range(20_000)])
    np.testing.assert_allclose(drawn.std(axis=0)[:, 0], [0.1, 0.2, 0.3, 0.4], rtol=0.03)
    alone = noise_of_all(noise.base_noise, 1)
    assert np.stack([alone() for _ in range(20_000)]).std() == pytest.approx(0.25, rel=0.03)  # the middle of the range


@pytest.mark.parametrize(("mean", "sigma"), [(np.zeros(2), 0.1), (0.0, np.full(2, 0.1))])
def test_a_number_stands_for_all_actions(mean, sigma):
    one = NormalActionNoise(mean, sigma)
    np.random.seed(0)
    expected = VectorizedActionNoise(one, 4)()
    np.random.seed(0)
    np.testing.assert_array_equal(noise_of_all(one, 4)(), expected)


def test_the_noise_of_one_environment_can_be_changed():
    noises = [
        kind(NormalActionNoise(np.zeros(2), np.ones(2)), 3) for kind in (VectorizedActionNoise, VectorizedNormalNoise)
    ]
    for noise in noises:
        noise.noises[1]._mu = np.full(2, 5.0)
        noise.noises[2]._sigma *= 0.5  # as a decaying noise does
        assert noise.noises[2]._sigma.tolist() == [0.5, 0.5]
    drawn = []
    for noise in noises:
        np.random.seed(0)
        drawn.append(noise())
    np.testing.assert_array_equal(*drawn)
    fast = noises[1]
    fast.noises = [NormalActionNoise(np.zeros(2), np.full(2, sigma)) for sigma in (1, 2, 3)]
    assert fast.sigma.tolist() == [[1, 1], [2, 2], [3, 3]]
    with pytest.raises(ValueError, match="noises must be 3 of NormalActionNoise"):
        fast.noises = fast.noises[:2]


class Scalar(TwoActions):
    action_space = gym.spaces.Box(-1.0, 1.0, (), np.float32)


@pytest.mark.filterwarnings("ignore:You have specified an action space")
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("algorithm", [TDC, MEOW, AdvBTD3, AdvBSAC, AdvBTDC])
@pytest.mark.parametrize("noise", [0.1, NormalActionNoise(np.zeros(()), np.full((), 0.1))])
def test_noise_of_actions_without_axes(algorithm, n_envs, noise):
    env = make_vec_env(Scalar, n_envs)  # checks every action
    settings = {"learning_starts": 8, "batch_size": 8, "buffer_size": 100, "policy_kwargs": {"net_arch": [8]}}
    model = algorithm("MlpPolicy", env, action_noise=noise, **settings).learn(24)
    assert model.replay_buffer.actions.shape[1:] == (n_envs, 1)


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("algorithm", [TDC, MEOW, AdvBTD3])
@pytest.mark.parametrize("is_of_all", [False, True])
def test_a_number_is_noise_of_every_action_on_its_own(algorithm, n_envs, is_of_all):
    noise = NormalActionNoise(0.0, 0.1)
    noise = VectorizedActionNoise(noise, n_envs) if is_of_all else noise
    model = algorithm("MlpPolicy", make_vec_env(TwoActions, n_envs), action_noise=noise, buffer_size=100)
    drawn = np.stack([model.action_noise() for _ in range(2000)]).reshape(2000, -1)
    np.testing.assert_allclose(np.cov(drawn.T), 0.01 * np.eye(2 * n_envs), atol=0.002)


@pytest.mark.parametrize("algorithm", [MEOW, AdvBTD3])
def test_noise_fits_the_environments_that_a_model_is_opened_for(tmp_path, algorithm):
    settings = {"learning_starts": 8, "batch_size": 8, "buffer_size": 100, "policy_kwargs": {"net_arch": [8]}}
    noise = NormalActionNoise(np.zeros(2), np.full(2, 0.1))
    model = algorithm("MlpPolicy", make_vec_env(TwoActions, 3), action_noise=noise, **settings).learn(12)
    model.save(tmp_path / "model")
    for n_envs in (1, 2):
        opened = algorithm.load(tmp_path / "model", env=make_vec_env(TwoActions, n_envs)).learn(20)
        assert np.shape(opened.action_noise()) == ((2,) if n_envs == 1 else (2, 2))


def test_a_subclass_that_draws_otherwise_keeps_its_own():
    class Uniform(NormalActionNoise):
        def __call__(self):
            return np.full(2, 0.5, np.float32)

    assert (noise_of_all(Uniform(np.zeros(2), np.ones(2)), 3)() == 0.5).all()


@pytest.mark.parametrize("largest", [None, 0.8])
def test_saved_and_opened_for_another_number_of_environments(tmp_path, largest):
    sigma = np.full(1, 0.2)
    one = NormalActionNoise(np.zeros(1), sigma) if largest is None else NormalNoiseRange(np.zeros(1), sigma, 4 * sigma)
    model = TDC("MlpPolicy", make_vec_env("Pendulum-v1", 3), action_noise=one, learning_starts=10, buffer_size=100)
    model.learn(30)
    model.save(tmp_path / "model")
    opened = load_safely(tmp_path / "model", env=make_vec_env("Pendulum-v1", 5))
    assert type(opened.action_noise) is VectorizedNormalNoise
    np.testing.assert_allclose(opened.action_noise.sigma.ravel(), np.linspace(0.2, largest or 0.2, 5))
