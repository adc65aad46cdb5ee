"""The update against an independent transcription, and which weights it may change."""

import copy
import functools
import operator

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.logger import configure
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn

from sb3_tdc import MEOW, NonFiniteError
from tests.helpers import meow_reference as reference
from tests.helpers.tdc import ACT, BATCH, OBS, BatchQueue, TwoActions, random_batches

LOW, HIGH = -4.0, 1.0


def make_model(**kwargs):
    policy_kwargs = {"net_arch": [8, 6], "shift_arch": [7, 5], "log_std_min": LOW, "log_std_max": HIGH}
    kwargs = {"policy_kwargs": {**policy_kwargs, "dropout": 0.0}, "seed": 3, "buffer_size": 500, **kwargs}
    model = MEOW("MlpPolicy", TwoActions(), device="cpu", **kwargs)
    with th.no_grad():  # away from the initial zeros, and the targets away from the networks
        for network in (model.network, model.network_target):
            for parameter in network.parameters():
                parameter.add_(0.2 * th.randn_like(parameter))
    return model


def train(model, batches, steps=1):
    model.replay_buffer = BatchQueue(batches)
    model.train(steps, batch_size=BATCH)


def layers_of(modules, index=None):
    """
    Return the layers of a Sequential in the form of the transcription.

    :param index: which one of several stacked networks
    """

    def double(tensor):
        tensor = tensor.detach().double().clone()
        return tensor if index is None else tensor[index].squeeze(0)

    layers = []
    for module in modules:
        if isinstance(module, nn.LayerNorm):
            layers[-1] |= {"norm_weight": double(module.weight), "norm_bias": double(module.bias)}
        elif hasattr(module, "beta"):
            layers[-1]["beta"] = double(module.beta)
        elif hasattr(module, "weight"):
            weight = double(module.weight)
            layers.append({"weight": weight if index is None else weight.T, "bias": double(module.bias).reshape(-1)})
    return layers


def weights_of(network):
    return {
        "couplings": [layers_of(coupling.translation) for coupling in network.flow.couplings],
        "prior": layers_of(network.flow.prior),
        "shifts": [layers_of(network.shifts, index) for index in range(2)],
    }


def flatten(weights):
    networks = [*weights["couplings"], weights["prior"], *weights["shifts"]]
    return [tensor for layers in networks for layer in layers for tensor in layer.values()]


@pytest.mark.parametrize("max_grad_norm", [1e6, 0.5], ids=["as it is", "clipped"])
def test_one_gradient_step_is_that_of_the_transcription(max_grad_norm):
    model = make_model(max_grad_norm=max_grad_norm, ent_coef=0.3, gamma=0.9, tau=0.1, learning_rate=1e-3)
    batch = next(random_batches(1))
    batch[3][0] = 1  # an episode that ended
    weights, target = weights_of(model.network), weights_of(model.network_target)
    before = [tensor.clone() for tensor in flatten(target)]
    parameters = [parameter.requires_grad_(True) for parameter in flatten(weights)]
    obs, actions, next_obs, dones, rewards = (part.double() for part in batch)
    rows = zip(obs, actions, rewards[:, 0], next_obs, dones[:, 0], strict=True)
    settings = {"alpha": 0.3, "gamma": 0.9, "low": LOW, "high": HIGH, "max_norm": max_grad_norm, "lr": 1e-3}
    loss, norm = reference.gradient_step(weights, target, parameters, list(rows), **settings)

    train(model, [batch])

    log = model._diagnostics.fetch()
    assert (log["loss"], log["grad_norm"]) == pytest.approx((loss, norm), rel=1e-4)
    assert 0.5 < norm < 1e6
    for found, expected in zip(flatten(weights_of(model.network)), parameters, strict=True):
        assert th.allclose(found, expected, atol=2e-5)
    for found, old, new in zip(flatten(weights_of(model.network_target)), before, parameters, strict=True):
        assert th.allclose(found, 0.9 * old + 0.1 * new, atol=2e-5)  # Polyak, after the step


def test_logged_values_are_those_of_the_equations():
    model = make_model(ent_coef=0.3, learning_rate=0.0, tau=0.0)
    batch = next(random_batches(1))
    batch[3][0] = 1  # an episode that ended
    weights, target = weights_of(model.network), weights_of(model.network_target)
    train(model, [batch])
    obs, actions, next_obs, dones, rewards = (part.double() for part in batch)
    q = [reference.q_values(weights, s, a, 0.3, LOW, HIGH) for s, a in zip(obs, actions, strict=True)]
    v = [reference.values(weights, s, 0.3, LOW, HIGH) for s in obs]
    next_v = [min(reference.values(target, s, 0.3, LOW, HIGH)) for s in next_obs]
    y = rewards[:, 0] + 0.99 * (1 - dones[:, 0]) * th.stack(next_v)
    log = model._diagnostics.fetch()
    assert log["q_value"] == pytest.approx(float(th.tensor(q).mean()), rel=1e-4)
    assert log["target"] == pytest.approx(float(y.mean()), rel=1e-4)
    log_prob = (th.tensor(q) - th.tensor(v)) / 0.3
    assert log["log_prob"] == pytest.approx(float(log_prob.mean()), rel=1e-4)


def test_gradients_reach_every_parameter():
    """Weights that start at 0 pass no gradient to the layers before them; after three updates they do."""
    model = MEOW("MlpPolicy", TwoActions(), seed=0, buffer_size=500, device="cpu")
    train(model, random_batches(4), steps=3)
    model.policy.optimizer.zero_grad(set_to_none=True)
    train(model, random_batches(1))
    for name, parameter in model.network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().max() > 0, name
    held = {id(parameter) for group in model.policy.optimizer.param_groups for parameter in group["params"]}
    assert held == {id(parameter) for parameter in model.network.parameters()}


def test_the_policy_is_the_same_whatever_the_reward_shifts():
    model = make_model()
    obs = th.randn(5, OBS)
    with th.no_grad():
        before = model.policy._predict(obs, deterministic=True)
        log_prob = operator.sub(*model.network(obs, before))
        for parameter in model.network.shifts.parameters():
            parameter.add_(th.randn_like(parameter))
        assert th.equal(model.policy._predict(obs, deterministic=True), before)
        assert th.allclose(operator.sub(*model.network(obs, before)), log_prob, atol=1e-4)


def record_modes(monkeypatch, network, method):
    """Record whether each call of a network's method finds it in training mode."""
    modes, original = [], getattr(network, method)

    @functools.wraps(original)
    def recording(*args, **kwargs):
        modes.append({module.training for module in network.modules()})
        return original(*args, **kwargs)

    monkeypatch.setattr(network, method, recording)
    return modes


def test_dropout_learns_and_neither_acts_nor_sets_targets(monkeypatch):
    model = MEOW("MlpPolicy", TwoActions(), learning_starts=4, batch_size=4, buffer_size=50, seed=0, device="cpu")
    learning = record_modes(monkeypatch, model.network, "forward")
    acting = record_modes(monkeypatch, model.network, "features")
    targets = record_modes(monkeypatch, model.network_target, "values")
    model.learn(12)
    model.predict(np.zeros(OBS, np.float32), deterministic=True)
    assert learning == [{True}] * 8
    assert targets == [{False}] * 8
    assert acting.count({True}) == 8  # the calls by forward
    assert acting.count({False}) == 8 + 1  # samples after the warm-up, and the prediction


def test_the_deterministic_action_is_scaled_and_repeats_itself():
    model = make_model()
    obs = np.random.default_rng(0).normal(size=(6, OBS)).astype(np.float32)
    actions, _ = model.predict(obs, deterministic=True)
    assert np.array_equal(model.predict(obs, deterministic=True)[0], actions)
    assert not np.array_equal(model.predict(obs)[0], model.predict(obs)[0])
    with th.no_grad():
        mode = model.network.flow.mode(th.tensor(obs)).numpy()
    assert np.allclose(actions, -0.4 + (mode + 1) / 2 * 2.4, atol=1e-6)


def test_the_target_of_n_step_returns_has_their_own_discounts():
    model = make_model(gamma=0.5)
    batch = next(random_batches(1))
    plain = model.compute_target(ReplayBufferSamples(*batch), 1.0)
    shorter = model.compute_target(ReplayBufferSamples(*batch, discounts=th.full((BATCH, 1), 0.25)), 1.0)
    rewards = batch[4]
    assert plain.shape == (BATCH, 1)
    assert th.allclose(shorter - rewards, (plain - rewards) / 2, atol=1e-6)


def test_a_temperature_that_is_changed_counts_from_the_next_update_on():
    first, second = make_model(ent_coef=0.2), make_model(ent_coef=0.7)
    second.ent_coef = 0.2
    for model in (first, second):
        th.manual_seed(0)
        train(model, random_batches(2), steps=2)
    assert all(map(th.equal, first.network.parameters(), second.network.parameters()))
    first.ent_coef = 0.0
    with pytest.raises(ValueError, match="ent_coef must be a finite number above 0"):
        first.train(1)


def test_a_loss_that_is_not_finite_ends_training_and_is_not_saved(tmp_path):
    model = make_model()
    batch = next(random_batches(1))
    batch[4][0] = th.inf
    model.set_logger(configure(None, []))
    with pytest.raises(NonFiniteError, match="loss is inf since update 1"):
        train(model, [batch])
    with pytest.raises(NonFiniteError, match="was not saved"):
        model.save(tmp_path / "model.zip")
    assert not (tmp_path / "model.zip").exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"ent_coef": 0}, "ent_coef must be a finite number above 0, got 0"),
        ({"ent_coef": "auto"}, "ent_coef must be a finite number above 0, got 'auto'"),
        ({"max_grad_norm": -1}, "max_grad_norm must be a finite number above 0, got -1"),
        ({"tau": 2}, "tau must be a finite number between 0.0 and 1.0, got 2"),
        ({"learning_rate": lambda left: -left}, "learning_rate .a schedule, at progress remaining 1. must be"),
        ({"policy_kwargs": {"dropout": 1.5}}, "policy_kwargs.'dropout'. must be"),
        *(
            (
                {"policy_kwargs": {name: layers}},
                f"policy_kwargs.'{name}'. must be a list of integers of at least 1, got ",
            )
            for name in ("net_arch", "shift_arch")
            for layers in (8, [0], [8.0], ["a"], {"pi": [8], "qf": [8]})
        ),
        ({"policy_kwargs": {"n_shifts": 0}}, "policy_kwargs.'n_shifts'. must be an integer of at least 1"),
        ({"policy_kwargs": {"log_std_max": -6}}, "policy_kwargs.'log_std_max'. must be a finite number of at least -5"),
    ],
)
def test_bad_arguments_are_one_sentence(arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        MEOW("MlpPolicy", TwoActions(), device="cpu", **arguments)


def test_copies_of_the_policy_predict_the_same(tmp_path):
    model = make_model()
    obs = np.zeros(OBS, np.float32)
    expected = model.predict(obs, deterministic=True)[0]
    model.policy.save(tmp_path / "policy.pth")
    loaded = type(model.policy).load(tmp_path / "policy.pth")
    for policy in (copy.deepcopy(model.policy), loaded):
        assert np.array_equal(policy.predict(obs, deterministic=True)[0], expected)
    assert expected.shape == (ACT,)
