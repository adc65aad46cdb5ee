import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_tdc.meow.policies import MEOWPolicy


@pytest.fixture(autouse=True)
def seed():
    th.manual_seed(0)


@pytest.fixture
def make_policy():
    """A policy with weights far from their initial zeros, in float64, in evaluation mode."""

    def make(obs_dim=3, action_dim=2, scale=0.3, **kwargs):
        boxes = [spaces.Box(-1, 1, (n,), np.float32) for n in (obs_dim, action_dim)]
        policy = MEOWPolicy(*boxes, lambda _: 1e-3, **{"net_arch": [8, 8], "shift_arch": [8, 8], **kwargs})
        with th.no_grad():
            for parameter in policy.parameters():
                parameter.add_(scale * th.randn_like(parameter))
        policy.set_training_mode(False)
        for network in (policy.network, policy.network_target):
            network.extract_features = lambda obs, _: obs  # SB3's preprocessing rounds to float32
        return policy.double()

    return make
