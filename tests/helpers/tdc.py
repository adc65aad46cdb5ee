"""Small TDC models, tasks and batches."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn

from sb3_tdc import TDC

OBS, ACT, BATCH = 3, 2, 5


class TwoActions(gym.Env):
    """Observations in R³, two actions in [-0.4, 2]: unequal bounds, so that scaling mistakes show."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (OBS,), np.float32)
    action_space = gym.spaces.Box(-0.4, 2.0, (ACT,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        self.episode = getattr(self, "episode", -1) + 1
        return self.np_random.normal(size=OBS).astype(np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.t += 1
        reward = -float(np.square(action).sum())
        timeout, terminal = (self.t == 5, False) if self.episode % 2 == 0 else (False, self.t == 7)
        return self.np_random.normal(size=OBS).astype(np.float32), reward, terminal, timeout, {}


def make_model(**kwargs):
    policy_kwargs = {"net_arch": [32, 24], "n_quantiles": 4, **kwargs.pop("policy_kwargs", {})}
    return TDC("MlpPolicy", TwoActions(), policy_kwargs=policy_kwargs, seed=3, buffer_size=500, device="cpu", **kwargs)


def random_batches(n, seed=0, batch=BATCH):
    rng = np.random.default_rng(seed)
    for _ in range(n):
        yield [
            th.tensor(x, dtype=th.float32)
            for x in (
                rng.normal(size=(batch, OBS)),
                rng.uniform(-1, 1, (batch, ACT)),
                rng.normal(size=(batch, OBS)),
                (rng.random((batch, 1)) < 0.3).astype(float),
                rng.normal(size=(batch, 1)) * 3,
            )
        ]


class BatchQueue:
    """Stands in for the replay buffer: returns the test's batches in order."""

    def __init__(self, batches):
        self.batches = iter(batches)

    def sample(self, batch_size, env=None):
        return ReplayBufferSamples(*next(self.batches))


SMALL = {"net_arch": [16, 16], "n_quantiles": 5}


HEADS = pytest.mark.parametrize("stochastic_actor", [False, True], ids=["deterministic", "stochastic"])


def make(env="Pendulum-v1", policy="MlpPolicy", algorithm=TDC, **kwargs):
    policy_kwargs = {**SMALL, **kwargs.pop("policy_kwargs", {})}
    defaults = {"learning_starts": 40, "batch_size": 16, "buffer_size": 500, "seed": 0, "device": "cpu"}
    return algorithm(policy, env, policy_kwargs=policy_kwargs, **{**defaults, **kwargs})


def weights(model):
    return {name: weight.clone() for name, weight in model.policy.state_dict().items()}


def assert_same_weights(a, b, but=()):
    for name, weight in a.items():
        assert th.equal(weight, b[name]) or name in but, name


class BatchNormExtractor(BaseFeaturesExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space, observation_space.shape[0])
        self.net = nn.Sequential(nn.Flatten(), nn.BatchNorm1d(self.features_dim))

    def forward(self, observations):
        return self.net(observations)


def states(model):
    """Return the weights of all networks and all state of the optimizers, as a flat dict of float64 tensors."""
    found = {f"policy.{name}": weight for name, weight in model.policy.state_dict().items()}
    for name in ("actor.optimizer", "critic.optimizer", "ent_coef_optimizer"):
        for i, state in model.get_parameters().get(name, {"state": {}})["state"].items():
            found.update({f"{name}.{i}.{key}": value for key, value in state.items()})
    return {name: value.detach().double().clone() for name, value in found.items()}


def assert_close(a, b, rtol, atol):
    assert a.keys() == b.keys()
    for name in a:
        th.testing.assert_close(a[name], b[name], rtol=rtol, atol=atol, msg=f"{name}: {{}}".format)
