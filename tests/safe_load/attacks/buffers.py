"""Replay buffers with hindsight that take gigabytes."""

import pickle

import numpy as np
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv

from sb3_tdc import TDC
from tests.safe_load.attacks.tools import with_fields

SMALL = {"learning_starts": 10, "batch_size": 8, "buffer_size": 300, "seed": 0, "device": "cpu"}


def make_model():
    env = BitFlippingEnv(n_bits=3, continuous=True)
    kwargs = {"replay_buffer_class": HerReplayBuffer, "policy_kwargs": {"net_arch": [4], "n_quantiles": 2}}
    return TDC("MultiInputPolicy", env, **kwargs, **SMALL).learn(30)


def large(folder, model):
    make_model().save(folder / "her.zip")
    return with_fields(folder / "her.zip", folder / "x.zip", buffer_size=10**7)


def outside(name, value):
    def make(folder, model):
        learned = make_model()
        buffer = learned.replay_buffer
        setattr(buffer, name, np.full_like(getattr(buffer, name), value))
        buffer.env = None
        (folder / "x.pkl").write_bytes(pickle.dumps(buffer))
        return folder / "x.pkl"

    return make


ATTACKS = {
    "hindsight over ten million transitions": large,
    "an episode that began a hundred million steps ago": outside("_current_ep_start", -(10**8)),
    "an episode of a hundred million steps": outside("ep_length", 10**8),
}
