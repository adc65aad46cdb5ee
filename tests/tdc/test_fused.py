"""The fused update equals the readable one up to float32 rounding, and leaves the same model."""

import copy

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_tdc import TDC
from sb3_tdc.tdc.fused import FusedUpdate
from tests.helpers.tdc import (
    BATCH,
    HEADS,
    SMALL,
    BatchNormExtractor,
    BatchQueue,
    TwoActions,
    assert_close,
    assert_same_weights,
    make,
    make_model,
    random_batches,
    states,
    weights,
)

# Every test with the compiled loops, and with PyTorch's in their place
pytestmark = pytest.mark.usefixtures("loops")


@HEADS
@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"lam": 0.0, "kappa": 0.0},
        {"lam": lambda progress: 0.3 * progress, "kappa": 10.0, "policy_delay": 3},
        {"policy_kwargs": {"n_critics": 1, "net_arch": [20]}},
        {"policy_kwargs": {"n_critics": 3, "n_quantiles": 1, "net_arch": {"pi": [8, 9, 10], "qf": [30, 20, 10]}}},
        {"ent_coef": 0.3, "policy_kwargs": {"optimizer_kwargs": {"eps": 1e-5, "betas": (0.8, 0.99)}}},
    ],
    ids=str,
)
def test_both_agree_over_hundreds_of_updates(stochastic_actor, kwargs):
    """On the same batches and random numbers. Rounding differs, and Adam amplifies it while moments are small."""

    def build(fused):
        fresh = {**kwargs, "policy_kwargs": dict(kwargs.get("policy_kwargs", {}))}
        return make_model(**fresh, stochastic_actor=stochastic_actor, fused=fused)

    start, finals = states(build(False)), []
    for fused in (False, True):
        model = build(fused)
        model.replay_buffer = BatchQueue(random_batches(300, batch=32))
        th.manual_seed(1)
        model.train(gradient_steps=300, batch_size=32)
        assert (model._fused_update is not None) is fused
        logged = model._diagnostics.fetch()
        finals.append(states(model) | {f"logged.{k}": th.tensor(v, dtype=th.float64) for k, v in logged.items()})
    assert_close(*finals, rtol=1e-3, atol=2e-5)
    # and the updates did something: the tolerance is far below the change
    assert max((finals[0][name] - weight).abs().max().item() for name, weight in start.items()) > 0.02


@HEADS
@pytest.mark.parametrize("kwargs", [{}, {"n_steps": 3}, {"normalize": True}], ids=str)
def test_both_agree_while_learning(stochastic_actor, kwargs):
    """Through replay, n-step returns and VecNormalize: the same actions lead to the same transitions."""
    models = []
    for fused in (False, True):
        env = make_vec_env(TwoActions, n_envs=2, seed=0)
        env = VecNormalize(env) if kwargs.get("normalize") else env
        n_steps = kwargs.get("n_steps", 1)
        models.append(make(env, stochastic_actor=stochastic_actor, fused=fused, n_steps=n_steps).learn(140))
    readable, fused = models
    assert (readable._fused_update is None, fused._fused_update is None) == (True, False)
    assert readable._n_updates == fused._n_updates > 40
    np.testing.assert_allclose(readable.replay_buffer.actions, fused.replay_buffer.actions, atol=1e-3)
    assert_close(states(readable), states(fused), rtol=1e-2, atol=1e-3)


def test_both_agree_where_batches_have_discounts_of_their_own():
    """As batches of n-step returns do, and also where the next batch has none again."""
    rng = np.random.default_rng(1)
    batches = list(random_batches(60))
    for batch in batches[::3]:
        batch.append(th.tensor(rng.random((BATCH, 1)), dtype=th.float32))
    models = [make_model(fused=fused) for fused in (False, True)]
    for model in models:
        model.replay_buffer = BatchQueue(batches)
        th.manual_seed(1)
        model.train(gradient_steps=60, batch_size=BATCH)
    assert_close(*map(states, models), rtol=1e-3, atol=2e-5)


@HEADS
def test_switching_in_mid_run(stochastic_actor):
    """Fused, readable, fused again: the state of the optimizers is kept."""
    reference = make_model(stochastic_actor=stochastic_actor, fused=False)
    switching = make_model(stochastic_actor=stochastic_actor, fused=True)
    for model in (reference, switching):
        model.replay_buffer = BatchQueue(random_batches(90))
        th.manual_seed(1)
        for i in range(3):
            model.fused = model is switching and i != 1
            model.train(gradient_steps=30, batch_size=BATCH)
    assert switching._fused_update is not None
    assert_close(states(reference), states(switching), rtol=1e-3, atol=1e-4)


@HEADS
def test_saved_files_are_the_same(tmp_path, stochastic_actor):
    """A model saved under the fused update continues under the readable one, and the other way round."""
    kwargs = {"stochastic_actor": stochastic_actor, "env": "Pendulum-v1"}
    for first, then in ((True, False), (False, True)):
        model = make(fused=first, **kwargs).learn(90)
        model.save(tmp_path / "model")
        loaded = TDC.load(tmp_path / "model", fused=then)
        assert_close(states(model), states(loaded), rtol=0, atol=0)
        assert loaded.fused is then
        for continued in (model, loaded):
            continued.replay_buffer = BatchQueue([])
            batches = [
                [t[:, :n] for t, n in zip(b, (3, 1, 3, 1, 1), strict=True)] for b in random_batches(21, batch=16)
            ]
            continued.replay_buffer = BatchQueue(batches)
            th.manual_seed(3)
            continued.train(gradient_steps=21, batch_size=16)
        assert_close(states(model), states(loaded), rtol=1e-3, atol=1e-5)


def test_replaced_parameters_are_noticed():
    model, other = make(fused=True), make(seed=5, fused=False).learn(80)
    model.learn(80)
    bound = model._fused_update
    model.set_parameters(other.get_parameters())
    assert_same_weights(weights(model), weights(other))
    model.train(gradient_steps=1, batch_size=16)
    assert model._fused_update is not bound  # the moments of the optimizers were replaced
    before = weights(model)
    model.policy.actor.mu[0].weight.data = model.policy.actor.mu[0].weight.data.clone()
    model.train(gradient_steps=2, batch_size=16)
    assert any(
        not th.equal(before[name], weight) for name, weight in weights(model).items() if name.startswith("actor.")
    )
    bound = model._fused_update
    model.critic.optimizer.state[model.critic.layers[0].weight] = {}
    model.train(gradient_steps=1, batch_size=16)
    assert model._fused_update is not bound


@pytest.mark.parametrize("fused", [False, True])
def test_a_frozen_temperature_stays(fused):
    model = make(stochastic_actor=True, fused=fused).learn(60)
    model.log_ent_coef.requires_grad_(False)
    before = model.log_ent_coef.clone()
    model.train(gradient_steps=4, batch_size=16)
    assert th.equal(model.log_ent_coef, before)


def test_another_batch_size_is_another_update():
    model = make(fused=True).learn(60)
    model.train(gradient_steps=2, batch_size=7)
    assert model._fused_update.batch_size == 7


def test_policies_can_be_copied_and_saved(tmp_path):
    model = make(fused=True).learn(60)
    copied = copy.deepcopy(model.policy)
    before = {name: weight.clone() for name, weight in copied.state_dict().items()}
    model.train(gradient_steps=4, batch_size=16)
    assert_same_weights(before, copied.state_dict())
    model.policy.save(tmp_path / "policy.pt")
    observation = np.array([0.1, 0.2, 0.3], np.float32)
    loaded = type(model.policy).load(tmp_path / "policy.pt")
    assert np.array_equal(loaded.predict(observation)[0], model.predict(observation)[0])


@pytest.mark.parametrize(
    ("kwargs", "reason"),
    [
        (
            {"policy_kwargs": {"activation_fn": nn.Tanh}},
            "the actor's layers are not linear ones with ReLU between them: .*Tanh",
        ),
        ({"policy_kwargs": {"optimizer_class": th.optim.SGD}}, "the actor's optimizer is not a plain Adam: SGD"),
        (
            {"policy_kwargs": {"optimizer_kwargs": {"weight_decay": 0.1}}},
            "the actor's optimizer is not a plain Adam: Adam with .*weight_decay",
        ),
        ({"policy_kwargs": {"net_arch": []}}, "the actor's layers are not linear ones with ReLU between them"),
        (
            {"policy_kwargs": {"features_extractor_class": BatchNormExtractor}},
            "the actor's features extractor is BatchNormExtractor",
        ),
    ],
    ids=str,
)
def test_what_stands_in_its_way_is_said(kwargs, reason, capsys):
    with pytest.raises(ValueError, match=f"fused must be None or False here: {reason}"):
        make(fused=True, **kwargs)
    assert make(verbose=1, **kwargs).learn(60)._fused_update is None
    assert "Using the readable update" in capsys.readouterr().out
    make(verbose=1)
    assert "Using the fused update, " in capsys.readouterr().out


def test_actions_are_those_of_the_policy():
    model = make(TwoActions(), fused=True, learning_starts=10, action_noise=None).learn(40)
    model._last_obs = np.random.default_rng(0).normal(size=(4, 3))
    action, scaled = model._sample_action(0, None, 4)
    expected, _ = model.predict(model._last_obs)
    np.testing.assert_allclose(action, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(scaled, model.policy.scale_action(expected), rtol=1e-5, atol=1e-5)


def test_float64_and_one_dimensional_actions():
    class Odd(TwoActions):
        observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
        action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    model = make(Odd(), policy_kwargs=SMALL, fused=True).learn(80)
    assert isinstance(model._fused_update, FusedUpdate)


class Counting(TDC):
    calls = 0

    def update_actor(self, replay_data):
        Counting.calls += 1
        super().update_actor(replay_data)


class OwnPolicy(type(make().policy)):
    pass


def test_what_a_user_overrides_is_called(monkeypatch):
    monkeypatch.setattr(Counting, "calls", 0)
    model = Counting("MlpPolicy", "Pendulum-v1", learning_starts=40, policy_kwargs=SMALL, device="cpu").learn(60)
    assert (Counting.calls, model._obstacles) == (model._n_updates // 2, ["update_actor is overridden"])
    own = TDC(OwnPolicy, "Pendulum-v1", learning_starts=40, policy_kwargs=SMALL, device="cpu").learn(60)
    assert own._obstacles == ["OwnPolicy is a custom class"]


def replace_optimizer(model):
    model.actor.optimizer = th.optim.SGD(model.actor.parameters(), lr=0.0)
    model.actor.optimizer.step = lambda: None


def freeze(model):
    for parameter in model.actor.parameters():
        parameter.requires_grad_(False)


def decay(model):
    model.actor.optimizer.param_groups[0]["weight_decay"] = 0.5


def hook(model):
    model.critic.register_forward_hook(lambda *_: None)


@pytest.mark.parametrize("change", [replace_optimizer, freeze, decay, hook])
@pytest.mark.parametrize("after", [0, 60], ids=["before learning", "in mid-run"])
def test_what_a_user_changes_counts(change, after):
    """It takes effect from the next step on, as with the readable update."""
    models = []
    for fused in (None, False):
        model = make(TwoActions(), fused=fused, seed=2)
        if after:
            model.learn(after)
            assert (model._fused_update is None) is (fused is False)
        change(model)
        models.append(model.learn(60, reset_num_timesteps=False))
        assert model._fused_update is None
    assert_close(*({k: v.double() for k, v in weights(m).items()} for m in models), rtol=1e-3, atol=1e-4)
    if change in (replace_optimizer, freeze) and not after:
        start = weights(make(TwoActions(), seed=2))
        assert all(th.equal(start[k], w) for k, w in weights(models[0]).items() if k.startswith("actor."))


def test_fresh_parameters_into_a_trained_model():
    """A fresh optimizer has no state at all."""
    model, fresh = make().learn(60), make(seed=3)
    model.set_parameters(fresh.get_parameters())
    assert_same_weights(weights(model), weights(fresh))
    model.learn(60, reset_num_timesteps=False)
    assert model._fused_update is not None


def test_replaced_targets_and_actors_are_noticed():
    model = make(tau=0.5).learn(60)
    for network in (model.critic_target, model.actor):
        nn.utils.vector_to_parameters(th.zeros(sum(p.numel() for p in network.parameters())), network.parameters())
    model._last_obs = np.ones((1, 3), np.float32)
    assert model._sample_action(0)[1].item() == 0.0 == model.predict(model._last_obs)[0].item()
    model.train(gradient_steps=2, batch_size=16)
    assert sum(p.abs().sum() for p in model.critic_target.parameters()) > 0


def test_a_buffer_that_returns_fewer_transitions():
    model = make_model(fused=True)
    model.replay_buffer = BatchQueue(
        [*random_batches(1, batch=3), *random_batches(1, batch=16), *random_batches(1, batch=1)]
    )
    before = weights(model)
    model.train(gradient_steps=3, batch_size=16)
    assert any(not th.equal(before[name], weight) for name, weight in weights(model).items())


@HEADS
@pytest.mark.parametrize("fused", [False, True])
def test_moments_about_to_be_denormal_become_zero(stochastic_actor, fused, monkeypatch):
    """At the same update on both paths; all other moments stay, even NaN."""
    monkeypatch.setattr("sb3_tdc.tdc.tdc.FLUSH_INTERVAL", 4)
    model = make_model(stochastic_actor=stochastic_actor, fused=fused)
    model.replay_buffer = BatchQueue(random_batches(6, batch=8))
    model.train(gradient_steps=3, batch_size=8)
    planted = {}
    for optimizer in (model.actor.optimizer, model.critic.optimizer):
        for group in optimizer.param_groups:
            group["lr"] = 0.0
        moment = next(iter(optimizer.state.values()))["exp_avg"].view(-1)
        moment[:5] = th.tensor([1e-38, -1e-36, 1e-22, -1e-45, float("nan")])
        planted[optimizer] = moment
    model._flush_moments()
    for moment in planted.values():
        assert [x == 0 for x in moment[:5].tolist()] == [True, True, False, True, False]
        moment[4] = 0.0
    calls = []
    monkeypatch.setattr(model, "_flush_moments", lambda: calls.append(model._n_updates))
    model.train(gradient_steps=3, batch_size=8)
    assert calls == [4]
