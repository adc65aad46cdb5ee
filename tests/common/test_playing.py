"""Playing a model, step by step."""

import pytest
from stable_baselines3.common.env_util import make_vec_env

from sb3_tdc.common.playing import play_episodes
from sb3_tdc.critics.episodes import record_episodes
from tests.helpers.tdc import TwoActions, make


@pytest.fixture
def played():
    env = make_vec_env(TwoActions)
    return make(TwoActions()), env


@pytest.mark.parametrize("n_timesteps", [0, 1, 19, 20, 45])
def test_no_more_steps_are_played_than_asked_for(played, n_timesteps):
    model, env = played
    steps, step = [], env.step
    env.step = lambda actions: steps.append(actions) or step(actions)
    episodes = list(play_episodes(model, env, n_timesteps=n_timesteps))
    assert len(steps) == n_timesteps
    assert sum(episode.length for episode in episodes) <= n_timesteps


@pytest.mark.parametrize("n_episodes", [0, 1, 3])
def test_as_many_episodes_are_recorded_as_asked_for(played, n_episodes):
    assert len(record_episodes(*played, n_episodes)) == n_episodes
