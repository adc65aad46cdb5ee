"""Models of every kind, to be saved and opened."""

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import DDPG, SAC, TD3, HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv, FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_tdc import TDC

TINY = {"learning_starts": 10, "batch_size": 8, "buffer_size": 300, "seed": 0, "device": "cpu"}


def noise(kind=NormalActionNoise):
    return kind(np.zeros(1), np.full(1, 0.3))


def pendulum(algorithm, policy_kwargs=None, n_envs=1, n=60, **kwargs):
    env = make_vec_env("Pendulum-v1", n_envs, seed=0)
    policy_kwargs = {"net_arch": [8, 8], **(policy_kwargs or {})}
    return algorithm("MlpPolicy", env, policy_kwargs=policy_kwargs, **{**TINY, **kwargs}).learn(n)


def goal_env():
    return BitFlippingEnv(n_bits=3, continuous=True)


def frames():
    return VecNormalize(VecFrameStack(DummyVecEnv([lambda: gym.make("Pendulum-v1")]), 3))


def linear():
    return LinearSchedule(1e-3, 0.0, 1.0)


HER = {"replay_buffer_class": HerReplayBuffer, "replay_buffer_kwargs": {"n_sampled_goal": 2}}


MODELS = {
    "tdc": lambda: pendulum(TDC, {"n_quantiles": 5, "activation_fn": th.nn.ELU}, lam=linear()),
    "tdc-stochastic": lambda: pendulum(TDC, n_envs=2, stochastic_actor=True, n_steps=3, qf_learning_rate=linear()),
    "tdc-fixed-temperature": lambda: pendulum(TDC, stochastic_actor=True, ent_coef=0.2, action_noise=None),
    "tdc-her": lambda: TDC("MultiInputPolicy", goal_env(), **HER, **TINY).learn(40),
    "tdc-dict": lambda: TDC("MultiInputPolicy", SimpleMultiObsEnv(discrete_actions=False), **TINY).learn(12),
    "tdc-image": lambda: TDC("CnnPolicy", FakeImageEnv(40, 40, n_channels=1, discrete=False), **TINY).learn(12),
    "tdc-frames": lambda: TDC("MlpPolicy", frames(), train_freq=(1, "episode"), **TINY).learn(210),
    "td3": lambda: pendulum(TD3, action_noise=noise(OrnsteinUhlenbeckActionNoise), learning_rate=linear()),
    "td3-vectorized-noise": lambda: pendulum(TD3, n_envs=2, action_noise=noise(), optimize_memory_usage=False),
    "ddpg": lambda: pendulum(DDPG, {"optimizer_class": th.optim.AdamW}, action_noise=noise()),
    "sac": lambda: pendulum(SAC, learning_rate=linear(), ent_coef="auto_0.1"),
    "sac-sde": lambda: pendulum(SAC, {"use_expln": True}, use_sde=True, use_sde_at_warmup=True),
    "sac-her": lambda: SAC("MultiInputPolicy", goal_env(), **HER, **TINY).learn(40),
}
