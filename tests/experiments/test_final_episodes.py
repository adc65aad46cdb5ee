"""Test episodes, compared with the same ones played by hand."""

import gymnasium as gym
import pytest
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_tdc import TDC
from sb3_tdc.cli import evaluate, train
from sb3_tdc.experiments import final_episodes
from sb3_tdc.experiments.final_episodes import read_test_returns
from sb3_tdc.experiments.results import Run
from tests.helpers.run_folders import make_run
from tests.helpers.searches import SMALL

HER = ["replay_buffer_class:HerReplayBuffer", "policy:MultiInputPolicy"]


gym.register("HindsightBits-v0", lambda **kwargs: BitFlippingEnv(n_bits=3, continuous=True), max_episode_steps=5)


def test_a_model_that_needs_its_environment_to_be_loaded(tmp_path):
    """With hindsight, the replay buffer asks the environment for rewards."""
    arguments = ["--env", "HindsightBits-v0", "-n", "60", "--seed", "1", "-f", str(tmp_path), "--verbose", "0"]
    assert train.main([*arguments, "--eval-freq", "30", "--eval-episodes", "1", "-params", *SMALL, *HER]) == 0
    assert evaluate.main([str(tmp_path), "--episodes", "3"]) == 0
    run = Run.open(tmp_path / "tdc" / "HindsightBits-v0_1")

    env = gym.make("HindsightBits-v0")
    model = TDC.load(run.folder.model, env, device="cpu")
    expected = []
    for seed in (10_000, 10_001, 10_002):
        observation, _ = env.reset(seed=seed)
        total, done = 0.0, False
        while not done:
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(action)
            total, done = total + reward, terminated or truncated
        expected.append(total)
    assert read_test_returns(run).tolist() == expected


class OwnExtractor(FlattenExtractor):
    """A custom class, which only a trusted model may name."""


def test_a_model_with_a_class_of_the_user_is_tested_if_it_is_trusted(tmp_path, capsys):
    kwargs = f"{{net_arch: [8], n_quantiles: 4, features_extractor_class: {__name__}.OwnExtractor}}"
    arguments = ["--env", "Pendulum-v1", "-n", "30", "--eval-freq", "-1", "-f", str(tmp_path), "--verbose", "0"]
    assert train.main([*arguments, "-params", *SMALL, f"policy_kwargs:{kwargs}"]) == 0
    capsys.readouterr()
    assert evaluate.main([str(tmp_path), "--episodes", "1"]) == 1
    assert "OwnExtractor" in capsys.readouterr().err
    run = Run.open(tmp_path / "tdc" / "Pendulum-v1_1")
    assert read_test_returns(run) is None
    assert evaluate.main([str(tmp_path), "--episodes", "1", "--trust"]) == 0
    assert "--trust: whatever code these files hold runs with your rights" in capsys.readouterr().err
    assert len(read_test_returns(run)) == 1


def test_nothing_is_played_whose_returns_cannot_be_written(tmp_path, monkeypatch):
    run = make_run(tmp_path)
    run.test_returns.mkdir()
    monkeypatch.setattr(final_episodes, "open_run", lambda *args: pytest.fail("it was opened to be played"))
    with pytest.raises(ValueError, match=r"^Test returns: \S+ cannot be written: Is a directory$"):
        final_episodes.measure_run(Run.open(run.path))
