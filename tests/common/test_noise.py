"""Noise of many environments is what SB3 draws for one after the other."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise

from sb3_tdc import TDC, load_safely
from sb3_tdc.common.noise import NormalNoiseRange, VectorizedNormalNoise, noise_of_all


@given(n_envs=st.integers(2, 40), n_actions=st.integers(1, 7), seed=st.integers(0, 1000), before=st.integers(0, 1))
def test_one_draw_is_the_draws_of_sb3(n_envs, n_actions, seed, before):
    one = NormalActionNoise(np.linspace(-1, 1, n_actions), np.linspace(0.1, 2, n_actions))
    drawn = []
    for noise in (VectorizedActionNoise(one, n_envs), VectorizedNormalNoise(one, n_envs)):
        np.random.seed(seed)
        np.random.normal(size=before)  # NumPy keeps every second number for the next call
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
    assert np.stack([alone() for _ in range(20_000)]).std() == pytest.approx(0.25, rel=0.03)  # the middle


@pytest.mark.parametrize(("mean", "sigma"), [(np.zeros(2), 0.1), (0.0, np.full(2, 0.1))])
def test_a_number_stands_for_all_actions(mean, sigma):
    one = NormalActionNoise(mean, sigma)
    np.random.seed(0)
    expected = VectorizedActionNoise(one, 4)()
    np.random.seed(0)
    np.testing.assert_array_equal(noise_of_all(one, 4)(), expected)


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
