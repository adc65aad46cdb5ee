"""Whatever a user changes in a model takes effect from the next update on, fused or readable."""

import copy
import inspect
import pickle
from multiprocessing import shared_memory
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.distributions import DiagGaussianDistribution, SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import BaseModel, BasePolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.sac import policies as sac_policies
from stable_baselines3.td3.policies import Actor as DeterministicActor
from torch import nn
from torch.nn.modules.module import register_module_forward_hook
from torch.optim.optimizer import register_optimizer_step_pre_hook

from sb3_tdc import TDC
from sb3_tdc.tdc.fused.replay import PackedReplay
from sb3_tdc.tdc.policies import QuantileCritic, TanhGaussian, TDCPolicy
from tests.helpers.tdc import ACT, HEADS, BatchQueue, TwoActions, assert_close, make, make_model, random_batches, states

CALLS: list[str] = []


@pytest.fixture(autouse=True)
def forget_calls():
    CALLS.clear()


def last_layer_of_actor(model):
    sequential = model.actor.latent_pi if model.stochastic_actor else model.actor.mu
    index = max(i for i, module in enumerate(sequential) if isinstance(module, nn.Linear))
    return sequential, index


def with_optimizer(model, network):
    network.optimizer = th.optim.Adam(network.parameters(), lr=3e-4)


# ---- each changes a model; what it puts there leaves a trace in CALLS when it is called


def replace_a_layer(model):
    sequential, index = last_layer_of_actor(model)
    th.manual_seed(7)
    sequential[index] = nn.Linear(sequential[index].in_features, sequential[index].out_features)
    with_optimizer(model, model.actor)


def replace_a_layer_and_keep_the_optimizer(model):
    sequential, index = last_layer_of_actor(model)
    sequential[index] = copy.deepcopy(sequential[index])  # nothing trains it now


def replace_the_layers_of_the_critic(model):
    th.manual_seed(8)
    fresh = TDC("MlpPolicy", model.env, policy_kwargs=model.policy_kwargs, seed=9, device="cpu")
    model.critic.layers = fresh.critic.layers
    with_optimizer(model, model.critic)


def replace_an_activation(model):
    sequential, index = last_layer_of_actor(model)
    sequential[index - 1] = nn.Tanh()


def insert_a_layer(model):
    sequential, index = last_layer_of_actor(model)
    sequential[index - 1] = nn.Sequential(nn.ReLU(), nn.Identity())


def replace_the_extractor(model):
    class Half(type(model.actor.features_extractor)):
        def forward(self, observations):
            CALLS.append("extractor")
            return super().forward(observations) / 2

    model.actor.features_extractor = Half(model.observation_space)


def replace_the_module_in_the_extractors(model):
    class Half(nn.Module):
        def forward(self, observations):
            CALLS.append("flatten")
            return observations.flatten(1) / 2

    for network in (model.actor, model.critic):
        network.features_extractor.flatten = Half()


def change_the_class_of_a_layer(model):
    class Half(nn.Linear):
        def forward(self, inputs):
            CALLS.append("layer")
            return super().forward(inputs) / 2

    sequential, index = last_layer_of_actor(model)
    sequential[index].__class__ = Half


def change_the_class_of_a_container(model):
    class Traced(nn.ModuleList):
        def __iter__(self):
            CALLS.append("layers")
            return super().__iter__()

    model.critic.layers.__class__ = Traced


def optimize_the_last_layer_only(model):
    sequential, index = last_layer_of_actor(model)
    model.actor.optimizer = th.optim.Adam(sequential[index].parameters(), lr=1e-2)


def optimize_in_another_order(model):
    model.critic.optimizer = th.optim.Adam(list(model.critic.parameters())[::-1], lr=1e-2)


def add_a_group(model):
    first, *others = model.critic.parameters()
    model.critic.optimizer = th.optim.Adam([{"params": [first], "lr": 1e-2}, {"params": others}], lr=1e-3)


def replace_the_group_in_its_list(model):
    groups = model.critic.optimizer.param_groups
    parameters = groups.pop()["params"]
    model.critic.optimizer.add_param_group({"params": parameters, "lr": 1e-3, "weight_decay": 0.1})


def replace_the_optimizers_step(model):
    optimizer = model.critic.optimizer
    own = optimizer.step

    def step(*args, **kwargs):
        CALLS.append("step")
        return own(*args, **kwargs)

    optimizer.step = step


def hook_a_parameter(model):
    def scale(gradient):
        CALLS.append("parameter hook")
        return gradient * 0.5

    next(model.critic.parameters()).register_hook(scale)


def hook_after_accumulation(model):
    next(model.actor.parameters()).register_post_accumulate_grad_hook(lambda p: CALLS.append("accumulated"))


def hook_an_optimizer_step(model):
    model.actor.optimizer.register_step_pre_hook(lambda *_: CALLS.append("before the step"))
    model.critic.optimizer.register_step_post_hook(lambda *_: CALLS.append("after the step"))


def hook_a_module_backwards(model):
    model.critic.layers[0].register_full_backward_hook(lambda *_: CALLS.append("backward"))


def replace_a_method_of_the_model(model):
    own = model.update_actor

    def update_actor(replay_data):
        CALLS.append("update_actor")
        own(replay_data)

    model.update_actor = update_actor


def replace_minimize(model):
    def minimize(output, optimizer, grad_output=None):
        CALLS.append("minimize")
        TDC._minimize(output, optimizer, grad_output)

    model._minimize = minimize


def replace_forward(model):
    own = model.actor.forward

    def forward(*args, **kwargs):
        CALLS.append("forward")
        return own(*args, **kwargs)

    model.actor.forward = forward


def replace_predict(model):
    own = model.policy.predict

    def predict(*args, **kwargs):
        CALLS.append("predict")
        actions, state = own(*args, **kwargs)
        return actions * 0.5, state

    model.policy.predict = predict


def replace_the_policys_forward(model):
    own = model.policy._predict

    def _predict(*args, **kwargs):
        CALLS.append("_predict")
        return own(*args, **kwargs) * 0.5

    model.policy._predict = _predict


def replace_the_forward_of_a_layer(model):
    layer = model.critic.layers[0]
    own = layer.forward

    def forward(inputs):
        CALLS.append("layer")
        return own(inputs) * 0.5

    layer.forward = forward


def replace_the_data_of_a_parameter(model):
    for parameter in model.critic.parameters():
        parameter.data = parameter.data * 0.5


def freeze_a_layer(model):
    model.critic.layers[0].weight.requires_grad_(False)


CHANGES = [
    replace_a_layer,
    replace_a_layer_and_keep_the_optimizer,
    replace_the_layers_of_the_critic,
    replace_an_activation,
    insert_a_layer,
    replace_the_extractor,
    replace_the_module_in_the_extractors,
    change_the_class_of_a_layer,
    change_the_class_of_a_container,
    optimize_the_last_layer_only,
    optimize_in_another_order,
    add_a_group,
    replace_the_group_in_its_list,
    replace_the_optimizers_step,
    hook_a_parameter,
    hook_after_accumulation,
    hook_an_optimizer_step,
    hook_a_module_backwards,
    replace_a_method_of_the_model,
    replace_minimize,
    replace_forward,
    replace_predict,
    replace_the_policys_forward,
    replace_the_forward_of_a_layer,
    replace_the_data_of_a_parameter,
    freeze_a_layer,
]
CALLED = {
    replace_the_extractor: "extractor",
    replace_the_module_in_the_extractors: "flatten",
    change_the_class_of_a_layer: "layer",
    change_the_class_of_a_container: "layers",
    replace_the_optimizers_step: "step",
    hook_a_parameter: "parameter hook",
    hook_after_accumulation: "accumulated",
    hook_an_optimizer_step: "before the step",
    hook_a_module_backwards: "backward",
    replace_a_method_of_the_model: "update_actor",
    replace_minimize: "minimize",
    replace_forward: "forward",
    replace_predict: "predict",
    replace_the_policys_forward: "_predict",
    replace_the_forward_of_a_layer: "layer",
}


def train(model, seed, n=6, batch=16):
    model.replay_buffer = BatchQueue(random_batches(n, seed=seed, batch=batch))
    th.manual_seed(seed)
    model.train(gradient_steps=n, batch_size=batch)


@HEADS
@pytest.mark.parametrize("before", [False, True], ids=["before the first update", "in mid-run"])
@pytest.mark.parametrize("change", CHANGES)
def test_a_change_counts_from_the_next_update_on(change, before, stochastic_actor):
    finals, calls = [], []
    for fused in (None, False):
        CALLS.clear()
        model = make_model(stochastic_actor=stochastic_actor, fused=fused)
        if before:
            train(model, 1)
            assert (model._fused_update is None) is (fused is False)
        change(model)
        for i in (2, 3):
            train(model, i)
        model._last_obs = np.linspace(-1, 1, 3, dtype=np.float32)[None]
        actions = model._sample_action(0)[0]
        assert np.allclose(actions, model.predict(model._last_obs)[0], atol=1e-6)
        calls.append(list(CALLS))
        finals.append(states(model) | {"actions": th.tensor(actions, dtype=th.float64)})
    assert calls[0] == calls[1]
    assert (CALLED[change] in calls[0]) if change in CALLED else not calls[0]
    assert_close(*finals, rtol=1e-3, atol=1e-4)


def test_the_target_of_a_replaced_part_moves(tmp_path):
    for fused in (None, False):
        model = make_model(fused=fused, tau=0.5)
        train(model, 1)
        replace_a_layer(model)
        _, index = last_layer_of_actor(model)
        start = model.actor_target.mu[index].weight.clone()
        train(model, 2, n=2)
        expected = (start + model.actor.mu[index].weight) / 2
        th.testing.assert_close(model.actor_target.mu[index].weight, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("fused", [None, False])
def test_a_tensor_of_one_element_replaced_by_an_equal_one_is_noticed(fused):
    """Equal tensors of one element are equal in Python's eyes; those of several elements cannot be compared."""

    class OneAction(TwoActions):
        action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    model = make(OneAction(), fused=fused)
    model.replay_buffer.add(np.ones(3), np.ones(3), np.ones(1), np.ones(1), np.zeros(1), [{}])
    model.train(4, 8)
    last, optimizer = model.actor.mu[-2], model.actor.optimizer
    state = optimizer.state[last.weight]
    state["step"] = state["step"].clone()
    model.train(4, 8)
    assert state["step"] == 4  # with policy_delay = 2
    trained, last.bias = last.bias, nn.Parameter(last.bias.detach().clone())
    before = [trained.item(), last.bias.item()]
    model.train(4, 8)
    assert [trained.item(), last.bias.item()] == before  # the optimizer does not have the new one
    optimizer.param_groups[0]["params"][-1] = last.bias
    model.train(4, 8)
    assert last.bias.item() != before[1] == trained.item()


@pytest.mark.parametrize("register", [register_module_forward_hook, register_optimizer_step_pre_hook])
def test_global_hooks_are_called(register):
    model = make_model()
    train(model, 1)
    handle = register(lambda *_: CALLS.append("global"))
    try:
        train(model, 2)
        assert len(CALLS) > 6
        assert model._fused_update is None
    finally:
        handle.remove()
    train(model, 3)
    assert model._fused_update is not None  # the fused update is used again


@pytest.mark.parametrize(
    ("place", "name"),
    [
        (nn.Linear, "forward"),
        (TanhGaussian, "log_prob_from_params"),
        (SquashedDiagGaussianDistribution, "log_prob"),
        (DiagGaussianDistribution, "log_prob"),
        (DiagGaussianDistribution, "proba_distribution"),
        (BaseModel, "extract_features"),
        (QuantileCritic, "extract_features"),
        (th.optim.Adam, "step"),
        (TDC, "_sample_target_actions"),
        (TDC, "predict"),
    ],
    ids=lambda x: x if isinstance(x, str) else x.__name__,
)
def test_a_method_replaced_on_a_class_is_called(place, name, monkeypatch):
    model = make_model(stochastic_actor=True)
    train(model, 1)
    assert model._fused_update is not None
    own = getattr(place, name)

    def replacement(*args, **kwargs):
        CALLS.append(name)
        return own(*args, **kwargs)

    monkeypatch.setattr(place, name, replacement)
    train(model, 2)
    model._last_obs = np.zeros((1, 3), np.float32)
    model._sample_action(0)
    assert name in CALLS


@pytest.mark.parametrize(
    ("place", "name"),
    [
        (TDC, "predict"),
        *((BasePolicy, name) for name in ("predict", "scale_action", "unscale_action")),
        *((TDCPolicy, name) for name in ("_predict", "set_training_mode")),
        *((BaseModel, name) for name in ("obs_to_tensor", "extract_features")),
        *((DeterministicActor, name) for name in ("forward", "_predict")),
        *((cls, "forward") for cls in (FlattenExtractor, nn.Flatten, nn.Linear, nn.ReLU, nn.Tanh, nn.Sequential)),
        (nn.Module, "__call__"),
        (None, "predict"),
    ],
    ids=lambda x: x if isinstance(x, str) else getattr(x, "__name__", "instance"),
)
def test_a_method_replaced_between_two_updates_acts_at_once(place, name, monkeypatch):
    model = make_model()
    train(model, 1)
    assert model._fused_update.acts()
    own = getattr(place or model, name)

    def replacement(*args, **kwargs):
        CALLS.append(name)
        return own(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(place or model, name, replacement)
        CALLS.clear()
        model._last_obs = np.zeros((1, 3), np.float32)
        model._sample_scaled_action(0, 1)
        assert name in CALLS
    assert model._fused_update.acts()


@pytest.mark.parametrize(
    ("network", "name"),
    [
        *(
            ("actor", name)
            for name in ("log_prob_from_params", "actions_from_params", "log_prob", "proba_distribution")
        ),
        *(("actor_target", name) for name in ("actions_from_params", "proba_distribution")),  # its density is not used
    ],
)
def test_a_method_replaced_on_a_distribution_is_called(network, name):
    model = make_model(stochastic_actor=True)
    train(model, 1)
    assert model._fused_update is not None
    distribution = getattr(model, network).action_dist
    own = getattr(distribution, name)

    def replacement(*args, **kwargs):
        CALLS.append(name)
        return own(*args, **kwargs)

    setattr(distribution, name, replacement)
    train(model, 2)
    assert name in CALLS


def test_a_replaced_distribution_is_used():
    class Narrow(TanhGaussian):
        def actions_from_params(self, mean, log_std, deterministic=False):
            CALLS.append("narrow")
            return super().actions_from_params(mean, log_std - 3, deterministic)

    model = make_model(stochastic_actor=True)
    train(model, 1)
    model.actor_target.action_dist = Narrow(ACT)
    train(model, 2)
    assert CALLS.count("narrow") == 6


@HEADS
@pytest.mark.parametrize("fused", [True, False])
def test_gradients_are_there_after_an_update(stochastic_actor, fused):
    """Those of the last update: with β₁ = 0 Adam's first moment is the gradient itself."""
    kwargs = {"policy_kwargs": {"optimizer_kwargs": {"betas": (0.0, 0.9)}}}
    model = make_model(stochastic_actor=stochastic_actor, fused=fused, **kwargs)
    for seed, reset in ((1, slice(None)), (2, slice(-1, None)), (3, slice(0))):
        train(model, seed)
        for network in (model.actor, model.critic):
            for parameter in network.parameters():
                moment = network.optimizer.state[parameter]["exp_avg"]
                th.testing.assert_close(parameter.grad, moment, rtol=1e-5, atol=1e-8)
            for parameter in list(network.parameters())[reset]:
                parameter.grad = None


class Minibatch(NamedTuple):
    rewards: th.Tensor
    dones: th.Tensor
    next_observations: th.Tensor
    observations: th.Tensor
    actions: th.Tensor
    discounts: None = None
    weights: float = 1.0


def test_a_minibatch_is_read_by_name():
    class Queue(BatchQueue):
        def sample(self, batch_size, env=None):
            observations, actions, next_observations, dones, rewards = next(self.batches)
            return Minibatch(rewards, dones, next_observations, observations, actions)

    models = [make_model(fused=fused) for fused in (True, False)]
    for model in models:
        model.replay_buffer = Queue(random_batches(10, batch=16))
        th.manual_seed(1)
        model.train(10, 16)
    assert_close(*map(states, models), rtol=1e-3, atol=2e-5)


# ---------------------------------------------------------------- storage


def plain_buffer(n=40):
    env = TwoActions()
    buffer = ReplayBuffer(n, env.observation_space, env.action_space, "cpu")
    rng = np.random.default_rng(0)
    for _ in range(n // 2):
        buffer.add(rng.normal(size=3), rng.normal(size=3), rng.normal(size=2), rng.normal(size=1), np.zeros(1), [{}])
    return buffer


def test_a_replay_buffer_in_a_file_or_in_shared_memory_stays_there(tmp_path):
    in_file, shared, view = plain_buffer(), plain_buffer(), plain_buffer()
    file = np.memmap(tmp_path / "observations", np.float32, "w+", shape=in_file.observations.shape)
    file[:] = in_file.observations
    in_file.observations = file
    memory = shared_memory.SharedMemory(create=True, size=shared.rewards.nbytes)
    try:
        shared.rewards = np.ndarray(shared.rewards.shape, np.float32, buffer=memory.buf)
        view.dones = np.zeros((80, 1), np.float32)[:40]
        for buffer, name in ((in_file, "observations"), (shared, "rewards"), (view, "dones")):
            array, model = getattr(buffer, name), make(TwoActions(), fused=True)
            model.replay_buffer = buffer
            model.train(gradient_steps=2, batch_size=8)
            assert getattr(buffer, name) is array
        del shared.rewards, array
    finally:
        memory.close()
        memory.unlink()


def test_two_models_share_the_rows_of_one_buffer():
    models = [make(TwoActions(), fused=True, seed=seed) for seed in (1, 2)]
    buffer = plain_buffer()
    for model in models:
        model.replay_buffer = buffer
    models[0].train(gradient_steps=1, batch_size=8)
    observations = buffer.observations
    for model in models * 2:
        model.train(gradient_steps=1, batch_size=8)
        assert buffer.observations is observations  # packed once
    assert models[0]._fused_update.packed_replay is models[1]._fused_update.packed_replay
    assert PackedReplay.of(buffer).holds(buffer)


@pytest.mark.parametrize("name", ["_get_samples", "_normalize_obs", "_normalize_reward", "to_torch"])
@pytest.mark.parametrize("on_class", [True, False], ids=["class", "instance"])
def test_a_method_of_the_buffer_that_is_replaced_is_called(name, on_class, monkeypatch):
    model = make(TwoActions(), fused=True)
    model.replay_buffer = plain_buffer()
    model.train(2, 8)
    assert model._fused_update.packed_replay is not None
    place = ReplayBuffer if on_class else model.replay_buffer
    own = inspect.getattr_static(ReplayBuffer, name)
    called = own.__func__ if isinstance(own, staticmethod) else getattr(place, name)

    def replacement(*args, **kwargs):
        CALLS.append(name)
        return called(*args, **kwargs)

    is_static = on_class and isinstance(own, staticmethod)
    monkeypatch.setattr(place, name, staticmethod(replacement) if is_static else replacement)
    model.train(2, 8)
    assert CALLS.count(name) >= 2


def test_an_array_of_the_buffer_that_is_kept_elsewhere_stays_the_buffer_s():
    """Its holder may write to it, and the model has to learn from what is written."""
    for view in (slice(None), slice(0, 3)):
        buffer = plain_buffer()
        kept = buffer.rewards[view] if view.stop else buffer.rewards
        model = make(TwoActions(), fused=True)
        model.replay_buffer = buffer
        model.train(2, 8)
        kept[0] = 123.0
        assert buffer.rewards[0] == 123
        del kept
        model.train(2, 8)
        assert model._fused_update.packed_replay.holds(buffer)  # nobody keeps it any more


def test_a_policy_in_shared_memory_stays_there():
    """Also when it is moved there in mid-run: another process sees every update."""
    for before in (True, False):
        model = make_model(fused=True)
        if before:
            train(model, 1)
        model.policy.share_memory()
        pointers = [p.data_ptr() for p in model.policy.parameters()]
        value = next(model.critic.parameters()).clone()
        train(model, 2)
        assert all(p.is_shared() for p in model.policy.parameters())
        assert pointers == [p.data_ptr() for p in model.policy.parameters()]
        assert not th.equal(value, next(model.critic.parameters()))


@HEADS
def test_a_fused_policy_is_pickled_as_small_as_any(stochastic_actor):
    readable, fused = (make_model(stochastic_actor=stochastic_actor, fused=fused) for fused in (False, True))
    train(readable, 1)
    train(fused, 1)
    sizes = [len(pickle.dumps(model.policy)) for model in (readable, fused)]
    assert sizes[1] < 1.05 * sizes[0]
    assert len(pickle.dumps(fused.actor)) < sizes[1]
    again = pickle.loads(pickle.dumps(fused.policy))
    observation = np.array([0.1, 0.2, 0.3], np.float32)
    assert np.array_equal(again.predict(observation)[0], fused.predict(observation)[0])


@HEADS
def test_a_copied_model_learns_on_its_own(stochastic_actor):
    model = make_model(stochastic_actor=stochastic_actor, fused=True)
    train(model, 1)
    reference = make_model(stochastic_actor=stochastic_actor, fused=True)
    train(reference, 1)
    model.replay_buffer = None  # the test's stand-in cannot be copied
    copied = copy.deepcopy(model)
    before = states(model)
    train(copied, 2)
    assert_close(before, states(model), rtol=0, atol=0)
    train(reference, 2)
    assert_close(states(reference), states(copied), rtol=0, atol=0)


def with_networks_of_its_own(original):
    """Return a shallow copy of a model that has another policy, optimizers included, and γ = 0."""
    model = copy.copy(original)
    model.policy = copy.deepcopy(original.policy)
    for name in ("actor", "actor_target", "critic", "critic_target"):
        setattr(model, name, getattr(model.policy, name))
    model.gamma = 0.0
    return model


def test_a_shallow_copy_trains_and_acts_by_itself():
    finals, actions = [], []
    for fused in (None, False):
        original = make_model(fused=fused, gamma=0.9)
        train(original, 1)
        model, before = with_networks_of_its_own(original), states(original)
        train(model, 2)
        assert_close(before, states(original), rtol=0, atol=0)
        assert (model._n_updates, original._n_updates) == (12, 6)
        finals.append(states(model))
        # a copy that has not been trained, from another observation and with another actor
        untrained = with_networks_of_its_own(original)
        nn.init.zeros_(untrained.actor.mu[-2].bias)
        untrained._last_obs = np.ones((1, 3), np.float32)
        actions.append(untrained._sample_action(0)[0])
        np.testing.assert_allclose(actions[-1], untrained.predict(untrained._last_obs)[0], atol=1e-6)
    assert_close(*finals, rtol=1e-3, atol=2e-5)
    np.testing.assert_allclose(*actions, atol=1e-4)


# ---------------------------------------------------------------- settings read in mid-run


@pytest.mark.parametrize("fused", [None, False])
def test_sb3s_learning_rate_schedule_is_read(fused):
    """So is a learning rate that replaces it later."""
    model = make(TwoActions(), fused=fused, learning_starts=10).learn(20)
    before = states(model)
    model.lr_schedule = lambda progress: 0.0
    model.learn(20, reset_num_timesteps=False)
    moved = [k for k, v in states(model).items() if k.startswith("policy.actor.") and not th.equal(v, before[k])]
    assert not moved
    model.learning_rate = 2e-3
    model.train(1, 8)
    assert model.actor.optimizer.param_groups[0]["lr"] == 2e-3


@pytest.mark.parametrize("fused", [None, False])
def test_a_hook_on_the_temperature_is_called(fused):
    model = make_model(stochastic_actor=True, fused=fused)
    train(model, 1)
    gradients = []

    def replace(gradient):
        gradients.append(gradient.item())
        return th.full_like(gradient, 7.0)

    model.log_ent_coef.register_hook(replace)
    train(model, 2, n=2)
    assert len(gradients) == 1
    assert gradients[0] != model.log_ent_coef.grad.item() == 7.0


@pytest.mark.parametrize("fused", [None, False])
def test_a_target_entropy_changed_in_mid_run_is_read(fused):
    gradients = []
    for target in (-100.0, 100.0):  # the gradient of log α is −mean(log π + H), on the same samples
        model = make_model(stochastic_actor=True, fused=fused)
        train(model, 1)
        model.target_entropy = target
        train(model, 2, n=2)
        gradients.append(model.log_ent_coef.grad.item())
    assert gradients[0] - gradients[1] == pytest.approx(200)
    model.target_entropy = "high"
    with pytest.raises(ValueError, match="target_entropy"):
        train(model, 3)


def test_the_reason_for_the_readable_update_is_said_once(capsys):
    model = make_model(verbose=1)
    train(model, 1)
    capsys.readouterr()
    replace_forward(model)
    for seed in (2, 3, 4):
        train(model, seed)
    output = capsys.readouterr().out
    assert output.count("Using the readable update (forward of a module of the actor is replaced)") == 1


def test_integer_observations_are_acted_on_as_predict_does():
    class Integers(TwoActions):
        observation_space = gym.spaces.Box(-9, 9, (3,), np.int64)

        def reset(self, **kwargs):
            super().reset(**kwargs)
            return np.array([1, -2, 3]), {}

        def step(self, action):
            _, *rest = super().step(action)
            return np.array([2, 0, -5]), *rest

    model = make(Integers(), fused=True, action_noise=None, learning_starts=10).learn(30)
    expected = model.predict(model._last_obs)[0]
    np.testing.assert_allclose(model._sample_action(0)[0], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("before", [True, False], ids=["in mid-run", "before the first update"])
@pytest.mark.parametrize("change", ["limit", "epsilon"])
def test_numbers_of_sb3s_density_count_if_they_are_changed(change, before, monkeypatch):
    finals = []
    for fused in (None, False):
        model = make_model(stochastic_actor=True, fused=fused)
        if before:
            train(model, 1)
        with monkeypatch.context() as patch:
            if change == "limit":
                patch.setattr(sac_policies, "LOG_STD_MAX", -1.0)
            else:
                model.actor.action_dist.epsilon = model.actor_target.action_dist.epsilon = 0.5
            train(model, 2)
            assert model._fused_update is None
        finals.append(states(model))
    assert_close(*finals, rtol=1e-3, atol=1e-4)


def test_another_default_precision_of_pytorch_changes_nothing():
    finals = []
    for default in (th.float32, th.float64):
        model = make_model()
        th.set_default_dtype(default)
        try:
            train(model, 1)
        finally:
            th.set_default_dtype(th.float32)
        assert model._fused_update is not None
        finals.append(states(model))
    assert_close(*finals, rtol=1e-6, atol=1e-7)
