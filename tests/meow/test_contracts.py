"""What users of SB3 rely on: their environments, observations, buffers, schedules and files."""

import copy

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv, FakeImageEnv, IdentityEnvBox, SimpleMultiObsEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_tdc import MEOW, NonFiniteError, UnsafeFileError, load_safely
from tests.helpers.tdc import BatchNormExtractor, TwoActions

TINY = {"learning_starts": 8, "batch_size": 8, "buffer_size": 300, "seed": 0, "device": "cpu"}
SMALL_NETWORKS = {"net_arch": [8, 8], "shift_arch": [8, 8]}


class OneAction(TwoActions):
    """One action, so that no element is inside the mask of every second coupling."""

    action_space = spaces.Box(-2.0, 2.0, (1,), np.float32)


class Matrix(TwoActions):
    """Actions in a matrix, observations in integers."""

    observation_space = spaces.MultiDiscrete([3, 4])
    action_space = spaces.Box(-1.0, 1.0, (2, 3), np.float64)

    def reset(self, **kwargs):
        _, info = super().reset(**kwargs)
        return self.observation_space.sample(), info

    def step(self, action):
        _, *rest = super().step(action)
        return self.observation_space.sample(), *rest


def make(env=TwoActions, policy="MlpPolicy", **kwargs):
    env = env() if isinstance(env, type) else env
    return MEOW(policy, env, **{**TINY, "policy_kwargs": SMALL_NETWORKS, **kwargs})


MODELS = {
    "flat": make,
    "one action": lambda: make(OneAction),
    "matrix": lambda: make(Matrix),
    "environments, n-step": lambda: make(make_vec_env(TwoActions, 3), n_steps=3, gradient_steps=-1),
    "VecNormalize": lambda: make(VecNormalize(DummyVecEnv([TwoActions]))),
    "schedule, noise": lambda: make(
        learning_rate=LinearSchedule(1e-3, 0.0, 1.0), action_noise=NormalActionNoise(np.zeros(2), np.full(2, 0.1))
    ),
    "episodes, memory": lambda: make(
        train_freq=(1, "episode"),
        optimize_memory_usage=True,
        replay_buffer_kwargs={"handle_timeout_termination": False},
    ),
    "dict": lambda: make(SimpleMultiObsEnv(discrete_actions=False), "MultiInputPolicy"),
    "image": lambda: make(FakeImageEnv(40, 40, n_channels=1, discrete=False), "CnnPolicy"),
    "HER": lambda: make(
        BitFlippingEnv(n_bits=3, continuous=True), "MultiInputPolicy", replay_buffer_class=HerReplayBuffer
    ),
    "three shifts, other optimizer": lambda: make(
        policy_kwargs={**SMALL_NETWORKS, "n_shifts": 3, "n_blocks": 1, "optimizer_class": th.optim.AdamW}
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_it_learns_is_saved_opened_and_continues(tmp_path, name):
    model = MODELS[name]()
    weights = [parameter.clone() for parameter in model.network.parameters()]
    model.learn(24)
    assert any(not th.equal(*pair) for pair in zip(weights, model.network.parameters(), strict=True))
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    env = model.get_env()
    obs = env.reset()
    expected, _ = model.predict(obs, deterministic=True)
    assert all(env.action_space.contains(action) for action in expected)
    n_updates = model._n_updates
    for loaded in (MEOW.load(tmp_path / "model", env), load_safely(tmp_path / "model", env, device="cpu")):
        assert type(loaded) is MEOW
        assert np.array_equal(loaded.predict(obs, deterministic=True)[0], expected)
        for module in ("network", "network_target"):
            pairs = zip(getattr(model, module).parameters(), getattr(loaded, module).parameters(), strict=True)
            assert all(th.equal(*pair) for pair in pairs)
        moments, saved = (m.policy.optimizer.state_dict()["state"] for m in (loaded, model))
        assert all(th.equal(moments[key]["exp_avg"], saved[key]["exp_avg"]) for key in saved)
        loaded.load_replay_buffer(tmp_path / "buffer")
        loaded.learn(24, reset_num_timesteps=False)
        assert loaded.num_timesteps >= 48
        assert loaded._n_updates > n_updates


def test_the_learning_rate_follows_its_schedule():
    model = make(learning_rate=lambda left: 1e-3 * left)
    model.learn(20)
    (group,) = model.policy.optimizer.param_groups
    assert group["lr"] == pytest.approx(0.0, abs=1e-9)
    model.learn(10, reset_num_timesteps=False)  # continues at 20 of 30 steps, with the last update at the end
    assert group["lr"] == pytest.approx(0.0, abs=1e-9)
    model.learning_rate = 5e-4
    model.train(1, 8)
    assert group["lr"] == 5e-4


def test_the_rewards_of_vec_normalize_reach_the_loss():
    env = VecNormalize(DummyVecEnv([TwoActions]), norm_obs=False)
    model = make(env, policy_kwargs={**SMALL_NETWORKS, "log_std_max": 0.0}, learning_rate=0.0)
    model.learn(60)
    raw = model.replay_buffer.rewards[:60, 0]
    scale = float(np.sqrt(env.ret_rms.var + env.epsilon))
    batch = model.replay_buffer.sample(200, env=env)
    assert batch.rewards.min().item() == pytest.approx((raw / scale).clip(-10, 10).min(), rel=1e-3)


@pytest.mark.parametrize("kwargs", [{"n_blocks": 10**9}, {"shift_arch": [10**9]}, {"n_shifts": 10**9}])
def test_a_file_that_asks_for_huge_networks_is_refused(tmp_path, kwargs):
    model = make()
    model.policy_kwargs = {**SMALL_NETWORKS, **kwargs}
    model.save(tmp_path / "model.zip")
    with pytest.raises(UnsafeFileError):
        load_safely(tmp_path / "model.zip")


def test_another_temperature_can_be_given_when_a_model_is_loaded(tmp_path):
    make(ent_coef=0.3).save(tmp_path / "model.zip")
    for load in (MEOW.load, load_safely):
        assert load(tmp_path / "model.zip").ent_coef == 0.3
        assert load(tmp_path / "model.zip", ent_coef=0.1).ent_coef == 0.1


class Broken(TwoActions):
    def step(self, action):
        obs, _, *rest = super().step(action)
        return obs, float("nan"), *rest


def test_a_reward_that_is_not_finite_is_not_stored():
    model = make(Broken)
    with pytest.raises(NonFiniteError, match="environment returned a non-finite reward"):
        model.learn(5)
    assert model.replay_buffer.pos == 0


def test_actions_other_than_bounded_ones_are_refused():
    with pytest.raises(ValueError, match="continuous actions"):
        make(gym.make("CartPole-v1"))


def test_identity():
    """SB3's identity task, where a constant action gets about 50 of 100."""
    env = DummyVecEnv([lambda: IdentityEnvBox(eps=0.5)])
    model = MEOW(
        "MlpPolicy",
        env,
        learning_starts=200,
        learning_rate=3e-3,
        gamma=0.4,
        ent_coef=0.05,
        batch_size=64,
        buffer_size=2_000,
        policy_kwargs={"net_arch": [32], "shift_arch": [32], "n_blocks": 1},
        seed=0,
        device="cpu",
    )
    before, _ = evaluate_policy(model, env, n_eval_episodes=10, warn=False)
    model.learn(700)
    after, _ = evaluate_policy(model, env, n_eval_episodes=10, warn=False)
    assert before < 70
    assert after > 90


@pytest.mark.slow
def test_pendulum():
    """A random policy gets about −1200, a solved task about −150."""
    model = MEOW("MlpPolicy", "Pendulum-v1", learning_starts=500, seed=0, device="cpu").learn(6_000)
    returns, _ = evaluate_policy(model, model.get_env(), n_eval_episodes=10, return_episode_rewards=True)
    assert np.mean(returns) > -300


@pytest.mark.parametrize(
    "copied", [lambda model: model, copy.deepcopy, lambda m: cloudpickle.loads(cloudpickle.dumps(m))]
)
def test_running_statistics_reach_the_target(copied):
    model = copied(make(policy_kwargs={**SMALL_NETWORKS, "features_extractor_class": BatchNormExtractor}))
    model.learn(40)
    online, target = (network.features_extractor.net[1] for network in (model.network, model.network_target))
    assert online.running_mean.abs().sum() > 0
    assert th.equal(online.running_mean, target.running_mean)
