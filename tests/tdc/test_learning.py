"""Both heads learn: SB3's identity task, where a constant action gets about 50 of 100."""

import numpy as np
import pytest
from stable_baselines3.common.envs import IdentityEnvBox
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tdc import TDC


@pytest.mark.parametrize("stochastic_actor", [False, True], ids=["deterministic", "stochastic"])
def test_identity(stochastic_actor):
    env = DummyVecEnv([lambda: IdentityEnvBox(eps=0.5)])
    model = TDC(
        "MlpPolicy",
        env,
        stochastic_actor=stochastic_actor,
        learning_starts=200,
        learning_rate=1e-3,
        gamma=0.4,
        batch_size=64,
        buffer_size=2_000,
        policy_kwargs={"net_arch": [64, 64], "n_quantiles": 16},
        seed=0,
        device="cpu",
    )
    before, _ = evaluate_policy(model, env, n_eval_episodes=10, warn=False)
    model.learn(1_800)
    after, _ = evaluate_policy(model, env, n_eval_episodes=10, warn=False)
    assert before < 70
    assert after > 90


@pytest.mark.slow
@pytest.mark.parametrize("stochastic_actor", [False, True], ids=["deterministic", "stochastic"])
def test_pendulum(stochastic_actor):
    """A random policy gets about −1200, a solved task about −150."""
    model = TDC(
        "MlpPolicy",
        "Pendulum-v1",
        stochastic_actor=stochastic_actor,
        learning_starts=1_000,
        learning_rate=1e-3,
        kappa=10.0,
        policy_kwargs={"net_arch": [128, 128], "n_quantiles": 32},
        seed=0,
        device="cpu",
    ).learn(12_000)
    returns, _ = evaluate_policy(model, model.get_env(), n_eval_episodes=10, return_episode_rewards=True)
    assert np.mean(returns) > -300
