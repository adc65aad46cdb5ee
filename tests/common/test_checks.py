"""Bad arguments that several algorithms share, each refused in one sentence before anything is built."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tdc.algorithms import ALGORITHMS
from sb3_tdc.hyperparams import parse
from sb3_tdc.runs.models import make_model

NUMBER = spaces.Box(-1, 1, (), np.float32)


class Observing(gym.Env):
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, space):
        self.observation_space = space


@pytest.mark.parametrize("algo", ALGORITHMS)
@pytest.mark.parametrize(
    ("policy", "space", "place"),
    [
        ("MlpPolicy", NUMBER, ""),
        ("MultiInputPolicy", spaces.Dict({"angle": NUMBER, "image": spaces.Box(0, 1, (2,))}), " in 'angle'"),
    ],
)
def test_observations_that_are_one_number_are_refused(algo, policy, space, place):
    """SB3's networks would fail at the first action that is not random."""

    def build_buffer(*args, **kwargs):
        raise AssertionError

    env = DummyVecEnv([lambda: Observing(space)])
    sentence = rf"at least one axis, got Box\(-1\.0, 1\.0, \(\), float32\){place}: give it the shape \(1,\)$"
    if algo not in ("td3", "sac", "ddpg"):  # SB3's own classes check nothing
        with pytest.raises(ValueError, match=sentence):
            ALGORITHMS[algo](policy, env, replay_buffer_class=build_buffer)
    with pytest.raises(ValueError, match=sentence):
        make_model(algo, parse({"n_timesteps": 10, "policy": policy}, ALGORITHMS[algo], "a file"), env)
