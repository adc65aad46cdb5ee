"""What λ does to the selection of the target critic, and which units are dormant: measured, and by hand."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch import nn

from sb3_tdc import TDC
from sb3_tdc.tdc import tdc
from sb3_tdc.tdc.diagnostics import describe_units
from sb3_tdc.tdc.dormant import dormant_share, relu_activations
from sb3_tdc.tdc.lam import critical_lam, describe_selection
from sb3_tdc.tdc.quantiles import Target, select_critic
from tests.helpers.tdc import HEADS, TwoActions, make


def target(mean, std, lam):
    mean, std = th.tensor(mean, dtype=th.float64), th.tensor(std, dtype=th.float64)
    return Target(th.zeros(len(mean), 1), mean, std, select_critic(mean, std, lam))


def test_critical_lam_by_hand():
    mean = th.tensor([[1.0, 3.0], [1.0, 3.0], [5.0, 2.0], [0.0, 0.0]])
    std = th.tensor([[1.0, 2.0], [2.0, 1.0], [4.0, 0.0], [1.0, 3.0]])
    # (3 − 1)/(2 − 1); the wider one has the smaller mean already; (5 − 2)/(4 − 0); equal means: any λ prefers the wider
    assert critical_lam(mean, std).tolist() == [2, th.inf, 0.75, 0]


numbers = arrays(np.float64, (6, 3), elements=st.floats(-5, 5, width=16))


@given(numbers, numbers, st.floats(0, 4, width=16))
def test_the_choice_changes_exactly_above_critical_lam(mean, std, lam):
    mean, std = th.tensor(mean), th.tensor(std).abs()
    critical = critical_lam(mean, std)
    clear = (critical - lam).abs() > 1e-6  # at the threshold itself, rounding decides
    changed = select_critic(mean, std, lam) != mean.argmin(dim=1)
    assert (changed == (lam > critical))[clear].all()


@given(numbers, numbers, st.floats(0, 4, width=16), st.floats(0, 4, width=16))
def test_a_larger_lam_never_adds_less(mean, std, one, other):
    few, many = (describe_selection(target(mean, np.abs(std), lam))["lam_adds"].item() for lam in sorted((one, other)))
    assert -1e-9 <= few <= many + 1e-9


def test_selection_by_hand():
    # λ = 1: 1 − 1 against 3 − 4: the second, which adds 2; 0 − 1 against 2 − 1: the first, which adds nothing
    found = describe_selection(target([[1.0, 3.0], [0.0, 2.0]], [[1.0, 4.0], [1.0, 1.0]], 1.0))
    assert {name: value.item() for name, value in found.items()} == pytest.approx(
        {
            "lam_changes": 0.5,
            "lam_adds": 1.0,
            "lam_adds_in_std": 1 / 2.5,  # σ of the selected: 4 and 1
            "lam_can_change": 0.5,
            **dict.fromkeys(("lam_critical_q10", "lam_critical_q50", "lam_critical_q90"), 2 / 3),
        }
    )


def test_where_no_lam_changes_anything_there_are_no_quantiles():
    found = describe_selection(target([[1.0, 3.0]], [[2.0, 1.0]], 5.0))
    assert {name: value.item() for name, value in found.items()} == {
        **dict.fromkeys(("lam_changes", "lam_adds", "lam_adds_in_std", "lam_can_change"), 0)
    }


def test_dormant_units_by_hand():
    # Means of |h|: 0, 4 and 8, and 0.025 of their mean is 0.1; then 0.05 and 4.05, and 0.025 of their mean is 0.05125
    first, second = th.tensor([[0.0, 4.0, 6.0], [0.0, -4.0, 10.0]]), th.tensor([[0.05, 4.05]])
    assert dormant_share([first]).item() == pytest.approx(1 / 3)
    assert dormant_share([first, second]).item() == pytest.approx(2 / 5)
    assert dormant_share([th.stack([first, th.zeros(2, 3)])]).item() == pytest.approx(4 / 6)  # two critics, one dead


def test_activations_are_those_of_the_layers():
    layers = [nn.Linear(2, 3), nn.ReLU(), nn.Linear(3, 1)]
    inputs = th.randn(5, 2)
    (hidden,), output = relu_activations(layers, inputs)
    assert th.equal(hidden, layers[0](inputs).clamp(min=0))
    assert th.equal(output, layers[2](hidden))


@pytest.mark.parametrize("fused", [False, None], ids=["readable", "fused"])
def test_an_override_gets_the_observations_of_the_minibatch(fused, monkeypatch):
    class Recording(TDC):
        def diagnose_units(self, observations):
            self.seen = observations.clone()

    monkeypatch.setattr(tdc, "UNITS_INTERVAL", 2)
    model = make(TwoActions(), algorithm=Recording, fused=fused)
    stored = np.arange(12.0).reshape(4, 3)
    for observation in stored:
        model.replay_buffer.add(observation, -observation, np.ones(2), np.ones(1), np.zeros(1), [{}])
    model.train(2, 16)
    assert (model._fused_update is None) is (fused is False)
    assert {tuple(row) for row in model.seen.tolist()} <= {tuple(row) for row in stored.tolist()}


class Pixels(TwoActions):
    """Observations that SB3 divides by 255."""

    observation_space = gym.spaces.Box(0, 255, (4, 4, 3), np.uint8)

    def reset(self, **kwargs):
        _, info = super().reset(**kwargs)
        return self.observation_space.sample(), info

    def step(self, action):
        _, *rest = super().step(action)
        return self.observation_space.sample(), *rest


def test_dormant_units_are_those_of_the_forward_pass():
    model = make(Pixels()).learn(60)
    with th.no_grad():
        model.actor.mu[0].bias.sub_(0.2)
    heard = []
    hook = model.actor.mu[1].register_forward_hook(lambda module, inputs, output: heard.append(output))
    batch = model.replay_buffer.sample(16)
    model.actor(batch.observations)
    hook.remove()
    model.diagnose_units(batch.observations)
    found = model._diagnostics.fetch()["actor_dormant"]
    second = model.actor.mu[3](model.actor.mu[2](heard[0]))
    assert found == pytest.approx(dormant_share([heard[0], second]).item())
    assert 0 < found < 1


@pytest.mark.parametrize(("network", "attribute"), [("actor", "mu"), ("critic", "layers"), (None, "actor")])
def test_other_networks_have_no_units_to_count(network, attribute):
    model = make(TwoActions())
    setattr(getattr(model, network) if network else model, attribute, nn.Linear(3, 2))
    assert describe_units(model, th.zeros(4, 3)) == {}


@HEADS
@pytest.mark.parametrize("fused", [False, None], ids=["readable", "fused"])
def test_dead_units_are_found_in_training(stochastic_actor, fused, monkeypatch):
    monkeypatch.setattr(tdc, "UNITS_INTERVAL", 3)
    model = make(stochastic_actor=stochastic_actor, fused=fused, learning_rate=0.0, qf_learning_rate=0.0)
    actor = model.actor.latent_pi if stochastic_actor else model.actor.mu
    with th.no_grad():
        actor[0].weight[:4], actor[0].bias[:4] = 0, -1  # 4 of 2 × 16 units of the actor
        model.critic.layers[2].weight[1], model.critic.layers[2].bias[1] = 0, -1  # 16 of 2 × 2 × 16 of the critics
    model.learn(50)
    logged = model.logger.name_to_value
    assert (model._fused_update is None) is (fused is False)
    assert logged["train/actor_dormant"] >= 4 / 32
    assert logged["train/critic_dormant"] >= 16 / 64
    assert logged["train/critic_dormant"] < 0.5


@HEADS
def test_both_paths_log_the_same(stochastic_actor, monkeypatch):
    monkeypatch.setattr(tdc, "UNITS_INTERVAL", 5)
    logs = []
    for fused in (False, True):
        model = make(stochastic_actor=stochastic_actor, fused=fused, lam=10.0).learn(120)
        logs.append({k: v for k, v in model.logger.name_to_value.items() if "lam" in k or "dormant" in k})
    assert logs[0].keys() == logs[1].keys() > {"train/lam_changes", "train/actor_dormant"}
    assert logs[0]["train/lam_changes"] > 0.1
    for name, value in logs[0].items():
        assert logs[1][name] == pytest.approx(value, rel=0.05, abs=0.02), name


def test_networks_of_another_kind_are_left_alone(monkeypatch):
    monkeypatch.setattr(tdc, "UNITS_INTERVAL", 5)
    model = make(policy_kwargs={"activation_fn": nn.ELU}).learn(60)
    assert "train/actor_dormant" not in model.logger.name_to_value
    assert "train/lam_changes" in model.logger.name_to_value
