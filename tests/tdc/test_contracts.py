"""What users of SB3 rely on: their schedules, environments, callbacks, files and copies."""

import copy
import csv
import functools
import inspect
import io
import json
import pickle

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC, TD3
from stable_baselines3.common import base_class
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import nn

from sb3_tdc import MEOW, TDC, NonFiniteError, load_safely
from sb3_tdc.common.finite import find_non_finite
from sb3_tdc.safe_load import UnsafeFileError
from sb3_tdc.tdc.tdc import DIAGNOSTICS_INTERVAL
from tests.helpers.tdc import HEADS, TwoActions

FUSED = pytest.mark.parametrize("fused", [False, None], ids=["readable", "fused"])


def make(env=TwoActions, policy="MlpPolicy", **kwargs):
    env = env() if isinstance(env, type) else env
    policy_kwargs = {"net_arch": [16, 16], "n_quantiles": 5, **kwargs.pop("policy_kwargs", {})}
    defaults = {"learning_starts": 10, "batch_size": 16, "buffer_size": 500, "seed": 0, "device": "cpu"}
    return TDC(policy, env, policy_kwargs=policy_kwargs, **{**defaults, **kwargs})


class Each(BaseCallback):
    """Calls a function with the model at every step."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def _on_step(self):
        self.function(self.model)
        return True


# ---------------------------------------------------------------- schedules and numbers


@pytest.mark.parametrize(
    "kwargs",
    [{"train_freq": (1, "episode")}, {"train_freq": (3, "episode")}, {"n_envs": 3}, {"train_freq": 11}],
    ids=str,
)
def test_a_schedule_is_asked_for_a_progress_between_1_and_0(kwargs):
    kwargs, asked = dict(kwargs), []

    def schedule(progress):
        asked.append(progress)
        return progress * 3e-4

    env = make_vec_env(TwoActions, n_envs=kwargs.pop("n_envs", 1))
    model = make(env, learning_rate=schedule, qf_learning_rate=schedule, lam=schedule, **kwargs)
    model.learn(100)
    assert model.num_timesteps > 100
    assert (max(asked), min(asked)) == (1.0, 0.0)


def test_sb3s_linear_schedule_to_zero_is_zero_at_its_end():
    """Rounding makes it −5e-20 at 5 % of progress remaining, which no learning rate may be."""
    schedule = LinearSchedule(3e-4, 0.0, 0.95)
    asked = []

    def recorded(progress):
        asked.append(schedule(progress))
        return asked[-1]

    rates = []
    model = make(learning_rate=recorded, qf_learning_rate=schedule, lam=schedule)
    model.learn(200, callback=Each(lambda model: rates.append(model.critic.optimizer.param_groups[0]["lr"])))
    assert min(asked) < 0  # otherwise the test would prove nothing
    assert min(rates) == 0


@pytest.mark.parametrize("convert", [np.array, th.tensor, np.float32, lambda x: th.tensor([x])], ids=str)
def test_a_schedule_may_return_whatever_float_takes(convert):
    rates = set()
    schedules = {name: lambda progress: convert(0.001) for name in ("learning_rate", "qf_learning_rate", "lam")}
    model = make(**schedules)
    model.learn(40, callback=Each(lambda model: rates.add(model.critic.optimizer.param_groups[0]["lr"])))
    assert type(max(rates)) is float
    assert model.critic.optimizer.param_groups[0]["lr"] == pytest.approx(0.001)


@pytest.mark.parametrize("algorithm", [SAC, TDC, MEOW])
def test_a_subclass_may_set_the_learning_rates(algorithm):
    given = []

    class Fixed(algorithm):
        def _update_learning_rate(self, optimizers):
            given.extend(optimizers if isinstance(optimizers, list) else [optimizers])
            for optimizer in given:
                optimizer.param_groups[0]["lr"] = 0.125

    head = {"stochastic_actor": True} if algorithm is TDC else {}
    model = Fixed("MlpPolicy", TwoActions(), learning_starts=3, batch_size=4, buffer_size=100, device="cpu", **head)
    if algorithm is MEOW:
        expected = [model.policy.optimizer]
    else:
        expected = [model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer]
    model.learn(4)
    assert list(map(id, given)) == list(map(id, expected))
    assert {optimizer.param_groups[0]["lr"] for optimizer in expected} == {0.125}


@pytest.mark.parametrize("value", [th.ones(2), np.ones(2), "0.1", True, None, 1j], ids=str)
def test_what_is_no_number_is_named(value):
    with pytest.raises(ValueError, match=r"lam \(a schedule, at progress remaining 1\) must be a finite number"):
        make(lam=lambda progress: value)


def test_numbers_of_numpy_and_yaml_become_those_of_python(tmp_path):
    numbers = {"learning_starts": 1e1, "batch_size": 16.0, "buffer_size": 5e2, "policy_delay": np.float64(2.0)}
    numbers |= {"learning_rate": np.float32(0.5), "lam": np.array(0.5), "tau": np.float64(0.5), "gamma": 1}
    model = make(**numbers, policy_kwargs={"n_quantiles": 5.0, "n_critics": np.int64(2)})
    for name, value in numbers.items():
        kind = int if name in ("learning_starts", "batch_size", "buffer_size", "policy_delay") else float
        assert (type(getattr(model, name)), getattr(model, name)) == (kind, value)
    model.learn(30)
    model.save(tmp_path / "model")
    assert load_safely(tmp_path / "model", device="cpu").learning_starts == 10
    assert TDC.load(tmp_path / "model", learning_starts=1e4).learning_starts == 10_000
    with pytest.raises(ValueError, match=r"learning_starts must be an integer of at least 0, got 1.5"):
        make(learning_starts=1.5)
    with pytest.raises(ValueError, match=r"buffer_size must be an integer of at least 1, got inf"):
        make(buffer_size=float("inf"))


@pytest.mark.parametrize("n_envs", [1, 3])
def test_action_noise_may_be_a_number_at_any_time(n_envs):
    model = make(make_vec_env(TwoActions, n_envs=n_envs), action_noise=None)
    seen = []

    def change(model):
        seen.append(model.action_noise)
        model.action_noise = {30: 0.05, 60: None, 75: NormalActionNoise(np.zeros(2), 0.2 * np.ones(2))}.get(
            model.num_timesteps, model.action_noise
        )

    model.learn(90, callback=Each(change))
    assert seen[0] is None
    used = [noise if n_envs == 1 else noise.noises[-1] for noise in (seen[40 // n_envs], model.action_noise)]
    assert [noise._sigma.tolist() for noise in used] == [[0.05, 0.05], [0.2, 0.2]]
    assert isinstance(model.action_noise, VectorizedActionNoise if n_envs > 1 else NormalActionNoise)
    with pytest.raises(ValueError, match=r"action_noise .* must be a finite number of at least 0.0, got -1"):
        model.action_noise = -1
    model.action_noise = 0.3
    model.learn(30, reset_num_timesteps=False)


def test_noises_of_several_environments_stay_what_they_are():
    noise = VectorizedActionNoise(OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2)), 2)
    model = make(make_vec_env(TwoActions, n_envs=2), action_noise=noise)
    model.learn(30)
    assert model.action_noise is noise
    assert np.abs(noise.noises[1].noise_prev).sum() > 0


# ---------------------------------------------------------------- environments


class Numbers(gym.Env):
    """Observes a vector, a Discrete number and flags; its last observation has values of Python, not of NumPy."""

    observation_space = spaces.Dict({"x": spaces.Box(-1, 1, (2,)), "n": spaces.Discrete(5), "m": spaces.MultiBinary(2)})
    action_space = spaces.Box(-1, 1, (2,))
    last = {"x": [0.5, 0.25], "n": 3, "m": (1, 0), "note": "more than the space has", "ragged": [[1], [2, 3]]}  # noqa: RUF012

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return {"x": np.zeros(2, np.float32), "n": 1, "m": np.zeros(2, np.int8)}, {}

    def step(self, action):
        self.t += 1
        observation = {"x": np.ones(2, np.float32), "n": 2, "m": np.ones(2, np.int8)}
        return (self.last if self.t == 4 else observation), 1.0, self.t == 4, False, {}


class ListsOfRewards(VecEnvWrapper):
    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, rewards.tolist(), dones, infos


class TerminalOf(VecEnvWrapper):
    """Gives the terminal observation as the simulator itself returned it."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        observations, rewards, dones, infos = self.venv.step_wait()
        for i in np.flatnonzero(dones):
            infos[i]["terminal_observation"] = self.venv.envs[i].unwrapped.last
        return observations, rewards, dones, infos


def test_observations_and_rewards_may_be_numbers_and_lists():
    env = TerminalOf(ListsOfRewards(DummyVecEnv([Numbers])))
    model = make(env, "MultiInputPolicy")
    model.learn(20)
    buffer = model.replay_buffer
    assert buffer.next_observations["x"][3, 0].tolist() == [0.5, 0.25]
    assert (buffer.next_observations["n"][3, 0], buffer.next_observations["n"][2, 0]) == (3, 2)
    assert buffer.next_observations["m"][3, 0].tolist() == [1, 0]
    assert buffer.rewards[:4].ravel().tolist() == [1.0] * 4


def test_a_list_with_a_nan_is_noticed():
    class Broken(Numbers):
        last = {**Numbers.last, "x": [0.5, float("nan")]}  # noqa: RUF012

    model = make(TerminalOf(DummyVecEnv([Broken])), "MultiInputPolicy")
    with pytest.raises(NonFiniteError, match=r"returned a non-finite x of .* at timestep 4"):
        model.learn(20)
    assert model.replay_buffer.pos == 3


@HEADS
@FUSED
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("shape", [(), (1,), (2, 3)], ids=str)
def test_actions_of_any_shape(tmp_path, stochastic_actor, fused, n_envs, shape):
    class Shaped(TwoActions):
        action_space = spaces.Box(-0.4, 2.0, shape, np.float32)

        def step(self, action):
            assert np.shape(action) == shape
            assert np.all((action >= -0.4 - 1e-6) & (action <= 2.0 + 1e-6))
            self.t += 1
            return self.np_random.normal(size=3).astype(np.float32), 0.0, self.t == 7, False, {}

    env = make_vec_env(Shaped, n_envs=n_envs)
    model = make(env, stochastic_actor=stochastic_actor, fused=fused, action_noise=0.5)
    model.learn(60)
    assert model.replay_buffer.actions.shape[1:] == (n_envs, int(np.prod(shape)))
    assert model.predict(np.zeros((n_envs, 3), np.float32))[0].shape == (n_envs, *shape)
    model.save(tmp_path / "model")
    for loaded in (TDC.load(tmp_path / "model", env), load_safely(tmp_path / "model", env, device="cpu")):
        loaded.learn(30)


def test_noise_of_scalar_actions_is_that_of_each_environment():
    class Scalar(TwoActions):
        action_space = spaces.Box(-1.0, 1.0, (), np.float32)

    model = make(make_vec_env(Scalar, n_envs=3), action_noise=0.1, learning_starts=0)
    model._setup_learn(100)
    model._last_obs = np.zeros((3, 3), np.float32)
    mean = model.predict(model._last_obs)[0]
    samples = np.array([model._sample_action(0, model.action_noise, 3)[1] for _ in range(2000)])
    assert samples.shape == (2000, 3)
    np.testing.assert_allclose(samples.mean(axis=0), mean, atol=0.02)
    np.testing.assert_allclose(np.cov(samples.T), 0.01 * np.eye(3), atol=0.002)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.Box(-3, 3, (2,), np.int64), r"of floating-point numbers, got Box\(-3, 3, \(2,\), int64\)"),
        (spaces.Box(0, 255, (2,), np.uint8), "of floating-point numbers"),
        (spaces.Box(-3e38, 3e38, (2,), np.float32), r"width, high − low, is finite in float32, .*RescaleAction"),
        (spaces.Box(-6e4, 6e4, (2,), np.float16), "is finite in float16"),
        (spaces.Box(np.array([-1, -2e38]), np.array([1, 2e38]), dtype=np.float32), "is finite in float32"),
    ],
    ids=str,
)
def test_action_spaces_that_cannot_be_scaled_are_refused_by_name(space, message):
    class Env(TwoActions):
        action_space = space

    with pytest.raises(ValueError, match=f"env must have an action space .*{message}"):
        make(Env)


def test_wide_bounds_within_the_range_of_their_numbers_are_allowed():
    class Wide(TwoActions):
        action_space = spaces.Box(-1e38, 1e38, (2,), np.float32)

    make(DummyVecEnv([Wide])).predict(np.zeros((1, 3), np.float32))


@FUSED
def test_observations_may_be_views_with_negative_strides(fused):
    class Reversed(VecEnvWrapper):
        def reset(self):
            return self.venv.reset()[..., ::-1]

        def step_wait(self):
            observations, *rest = self.venv.step_wait()
            return (observations[..., ::-1], *rest)

    model = make(Reversed(make_vec_env(TwoActions, n_envs=2)), fused=fused, action_noise=None)
    model.learn(60)
    actions = model._sample_action(0, None, 2)[0]
    np.testing.assert_allclose(actions, model.predict(model._last_obs.copy())[0], rtol=1e-5, atol=1e-6)


def test_an_environment_of_openai_gym_is_converted_before_it_is_looked_at(monkeypatch):
    """SB3 converts such an environment, and its spaces, which are not Gymnasium's."""

    class OldSpace:
        pass

    class OldEnv:
        observation_space = action_space = OldSpace()

    converted = base_class._patch_env
    monkeypatch.setattr(
        base_class, "_patch_env", lambda env: TwoActions() if isinstance(env, OldEnv) else converted(env)
    )
    assert make(OldEnv).action_space.shape == (2,)


# ---------------------------------------------------------------- networks


class Masked(BaseFeaturesExtractor):
    """An extractor with a constant that is infinite by design, and with running statistics of its inputs."""

    def __init__(self, observation_space):
        super().__init__(observation_space, observation_space.shape[0])
        self.register_buffer("mask", th.full((3, 3), -th.inf).triu(1))
        self.norm = nn.BatchNorm1d(3)

    def forward(self, observations):
        return self.norm(observations) @ (self.mask.softmax(dim=1))


@pytest.mark.parametrize("shared", [False, True], ids=["separate", "shared"])
def test_an_infinite_constant_is_saved_and_loaded(tmp_path, shared):
    policy_kwargs = {"features_extractor_class": Masked, "share_features_extractor": shared}
    model = make(policy_kwargs=policy_kwargs)
    model.learn(40, callback=CheckpointCallback(20, tmp_path))
    path = tmp_path / "rl_model_40_steps.zip"
    given = {"custom_objects": {"policy_kwargs": {**model.policy_kwargs, "n_quantiles": 5}}, "device": "cpu"}
    for loaded in (TDC.load(path), load_safely(path, **given)):
        assert th.equal(loaded.actor.features_extractor.mask, model.actor.features_extractor.mask)

    good = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    for name in ("norm.weight", "norm.running_mean", "norm.running_var"):
        with th.no_grad():
            model.actor.features_extractor.state_dict()[name][1] = th.nan
        with pytest.raises(NonFiniteError, match=rf"model of step 40 was not saved: .*features_extractor.{name}"):
            model.save(tmp_path / "model.zip")
        unsafe = tmp_path / "unsafe.zip"
        OffPolicyAlgorithm.save(model, unsafe)
        with pytest.raises(UnsafeFileError, match=rf"features_extractor.{name} has values that are not finite"):
            load_safely(unsafe, **given)
        model.policy.load_state_dict(good)


def test_both_names_of_a_shared_parameter_are_looked_at():
    """A file may have different values under them, of which the last would be loaded."""
    policy = make(policy_kwargs={"features_extractor_class": Masked, "share_features_extractor": True}).policy
    for name in ("actor.features_extractor.norm.bias", "critic.features_extractor.norm.bias"):
        assert find_non_finite(policy, {**policy.state_dict(), name: th.tensor([0.0, th.nan, 0.0])}) == [name]


@FUSED
@pytest.mark.parametrize(
    ("name", "make_part"),
    [
        ("activation_fn", functools.partial(nn.LeakyReLU, negative_slope=0.2)),
        ("activation_fn", functools.partial(nn.ReLU)),
        ("features_extractor_class", functools.partial(FlattenExtractor)),
        ("optimizer_class", functools.partial(th.optim.AdamW, weight_decay=0.1)),
        ("optimizer_class", lambda parameters, lr, **kwargs: th.optim.SGD(parameters, lr=lr)),
    ],
    ids=str,
)
def test_what_makes_a_part_of_the_networks_need_not_be_a_class(tmp_path, fused, name, make_part, capsys):
    model = make(policy_kwargs={name: make_part}, fused=fused, verbose=1)
    model.learn(30)
    assert fused is False or "Using the " in capsys.readouterr().out  # the parts are named
    model.save(tmp_path / "model")
    assert TDC.load(tmp_path / "model", env=TwoActions()).learn(30)._n_updates > 0


@HEADS
@FUSED
def test_policies_are_copied_and_pickled_after_an_update(stochastic_actor, fused):
    model = make(stochastic_actor=stochastic_actor, fused=fused)
    model.learn(20)
    model.train(2, 16)
    copies = [copy.deepcopy(model.policy)]
    model.actor(th.zeros(4, 3))  # leaves its graph behind
    copies += [copy.deepcopy(model.policy), pickle.loads(pickle.dumps(model.policy))]
    actor = copy.deepcopy(model.actor)
    observations = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    for policy in copies:
        assert np.array_equal(policy.predict(observations)[0], model.predict(observations)[0])
    observation = th.from_numpy(observations)
    assert th.equal(actor._predict(observation, True), model.actor._predict(observation, True))


@pytest.mark.parametrize("algorithm", [TD3, TDC, MEOW])
def test_a_module_replaced_between_predictions_has_the_mode_of_its_network(algorithm):
    model = algorithm("MlpPolicy", TwoActions(), buffer_size=100, learning_starts=5, device="cpu")
    observation = np.ones(3, np.float32)
    expected, _ = model.predict(observation, deterministic=True)
    network = model.policy.network if algorithm is MEOW else model.actor
    dropout = nn.Dropout(0.5)
    network.features_extractor.flatten = nn.Sequential(nn.Flatten(), dropout)
    for _ in range(3):
        assert np.array_equal(model.predict(observation, deterministic=True)[0], expected)
    model.policy.set_training_mode(True)
    dropout.eval()
    model.policy.set_training_mode(True)
    assert dropout.training


# ---------------------------------------------------------------- the temperature


@pytest.mark.parametrize("algorithm", [TDC, SAC])
def test_a_fixed_temperature_has_no_logarithm_and_no_optimizer(tmp_path, algorithm):
    """Callbacks written for SAC read these attributes."""
    head = {"stochastic_actor": True} if algorithm is TDC else {}
    for ent_coef in (0.2, "auto"):
        model = algorithm("MlpPolicy", TwoActions(), ent_coef=ent_coef, buffer_size=100, learning_starts=5, **head)
        learned = ent_coef == "auto"
        assert (model.log_ent_coef is not None, model.ent_coef_optimizer is not None) == (learned, learned)
        model.learn(20)
        model.save(tmp_path / "model")
        for loaded in (algorithm.load(tmp_path / "model"), load_safely(tmp_path / "model", device="cpu")):
            assert (loaded.log_ent_coef is not None, loaded.ent_coef_optimizer is not None) == (learned, learned)


@pytest.mark.parametrize("algorithm", [SAC, TDC])
def test_the_target_entropy_is_a_number(tmp_path, algorithm):
    """Of two actions: −2."""
    head = {"stochastic_actor": True} if algorithm is TDC else {}
    model = algorithm("MlpPolicy", TwoActions(), buffer_size=100, learning_starts=5, batch_size=4, **head)
    assert (type(model.target_entropy), model.target_entropy) == (float, -2.0)

    def lower(model):
        model.target_entropy -= 0.5

    model.learn(4, callback=Each(lower))
    assert model.target_entropy == -4.0
    for saved in (-4.0, "auto"):
        model.target_entropy = saved
        model.save(tmp_path / "model")
        for read in (algorithm.load, load_safely):
            read_again = functools.partial(read, tmp_path / "model", env=TwoActions(), device="cpu")
            assert read_again().target_entropy == (-2.0 if saved == "auto" else -4.0)
            assert read_again(target_entropy="auto").target_entropy == -2.0


def test_the_deterministic_head_has_no_temperature(tmp_path):
    model = make(ent_coef=0.3)
    model.save(tmp_path / "model")
    for each in (model, TDC.load(tmp_path / "model"), load_safely(tmp_path / "model", device="cpu")):
        assert (each.log_ent_coef, each.ent_coef_optimizer, each.ent_coef_tensor) == (None, None, None)


@pytest.mark.parametrize("given", ["kwargs", "custom_objects"])
@pytest.mark.parametrize("reader", ["load", "load_safely", "load_safely of SAC"])
@pytest.mark.parametrize(
    ("saved", "new", "expected"),
    [
        ("auto_0.5", 0.1, 0.1),
        (0.5, "auto_0.1", 0.1),
        (0.5, "auto", 1.0),
        (0.5, 0.1, 0.1),
        (0.5, 0.5, 0.25),  # unchanged: the value in the file
        ("auto_0.5", "auto_0.5", 0.25),
        ("auto_0.5", "auto_0.1", 0.1),
    ],
)
def test_another_temperature_than_the_files(tmp_path, saved, new, expected, reader, given):
    sac = reader.endswith("SAC")
    head = {} if sac else {"stochastic_actor": True, "policy_kwargs": {"net_arch": [8]}}
    model = (SAC if sac else TDC)("MlpPolicy", TwoActions(), ent_coef=saved, buffer_size=100, learning_starts=5, **head)
    with th.no_grad():  # it has been learned, or changed by a callback, to 0.25
        if model.log_ent_coef is None:
            model.ent_coef_tensor.fill_(0.25)
        else:
            model.log_ent_coef.fill_(float(np.log(0.25)))
    model.save(tmp_path / "model")
    read = TDC.load if reader == "load" else load_safely
    kwargs = {"ent_coef": new} if given == "kwargs" else {"custom_objects": {"ent_coef": new}}
    loaded = read(tmp_path / "model", env=TwoActions(), device="cpu", **kwargs)
    found = loaded.ent_coef_tensor if loaded.log_ent_coef is None else loaded.log_ent_coef.exp()
    assert found.item() == pytest.approx(expected)
    assert loaded.ent_coef == new
    assert (loaded.ent_coef_optimizer is not None) == isinstance(new, str)
    loaded.learn(30)
    loaded.save(tmp_path / "again")
    assert read(tmp_path / "again").ent_coef == new


@pytest.mark.parametrize(
    "read", [lambda algorithm: algorithm.load, lambda algorithm: load_safely], ids=["load", "safe"]
)
@pytest.mark.parametrize("algorithm", [TDC, MEOW])
@pytest.mark.parametrize(("saved", "new"), [(3, {"gamma": 0.5}), (3, {"n_steps": 1}), (1, {"n_steps": 3}), (3, {})])
def test_a_loaded_model_takes_the_n_step_returns_that_it_is_given(tmp_path, saved, new, algorithm, read, recwarn):
    """SB3 saves the replay buffer that it chose, with its n and γ, and would load those again."""
    size = {"buffer_size": 100, "learning_starts": 10, "batch_size": 4, "device": "cpu"}
    user_kwargs = {"handle_timeout_termination": False}
    first = algorithm("MlpPolicy", TwoActions(), n_steps=saved, replay_buffer_kwargs=user_kwargs, **size).learn(12)
    first.save(tmp_path / "model")
    model = read(algorithm)(tmp_path / "model", env=TwoActions(), **new)
    n_steps, gamma = new.get("n_steps", saved), new.get("gamma", 0.99)
    assert type(model.replay_buffer) is (NStepReplayBuffer if n_steps > 1 else ReplayBuffer)
    assert not model.replay_buffer.handle_timeout_termination
    assert user_kwargs == {"handle_timeout_termination": False}
    model.learn(40)
    assert not [warned for warned in recwarn if "n_steps" in str(warned.message)]
    if n_steps > 1:
        assert model.replay_buffer.n_steps == n_steps
        assert model.replay_buffer.sample(100).discounts.min().item() == pytest.approx(gamma**n_steps)
        model.gamma = 0.25
        model.learn(5, reset_num_timesteps=False)
        assert model.replay_buffer.sample(100).discounts.min().item() == pytest.approx(0.25**n_steps)


@pytest.mark.parametrize("read", [TDC.load, load_safely])
def test_a_replay_buffer_that_the_user_chose_is_loaded_as_it_was(tmp_path, read):
    chosen = {"replay_buffer_class": NStepReplayBuffer, "replay_buffer_kwargs": {"n_steps": 2, "gamma": 0.7}}
    make(**chosen).save(tmp_path / "model")
    model = read(tmp_path / "model", env=TwoActions(), gamma=0.9)
    model.learn(40)
    assert (model.replay_buffer.n_steps, model.replay_buffer.gamma) == (2, 0.7)


def test_a_bad_temperature_is_refused_when_a_model_is_loaded(tmp_path):
    make(stochastic_actor=True).save(tmp_path / "model")
    for read in (TDC.load, load_safely):
        with pytest.raises(ValueError, match=r"ent_coef must be .* got -1"):
            read(tmp_path / "model", ent_coef=-1)


@FUSED
def test_a_temperature_changed_in_mid_run_is_used_and_saved(tmp_path, fused):
    model = make(stochastic_actor=True, fused=fused)
    model.learn(30)
    model.ent_coef = 0.125
    model.learn(30)
    assert model.logger.name_to_value["train/ent_coef"] == 0.125
    assert model.log_ent_coef is None
    model.ent_coef = "auto_0.25"
    model.save(tmp_path / "model")
    for loaded in (TDC.load(tmp_path / "model"), load_safely(tmp_path / "model", device="cpu")):
        assert loaded.log_ent_coef.exp().item() == pytest.approx(0.25)


# ---------------------------------------------------------------- the log


@HEADS
@FUSED
def test_what_callbacks_read_after_an_update(stochastic_actor, fused):
    rates = []
    model = make(
        stochastic_actor=stochastic_actor, fused=fused, learning_rate=lambda p: p, qf_learning_rate=0.25, lam=0.5
    )

    class Reads(BaseCallback):
        def _on_step(self):
            if self.model._n_updates > 0:  # train() ran before this step
                values = self.logger.name_to_value
                assert values["train/n_updates"] == self.model._n_updates
                rates.append(values["train/learning_rate"])
                assert (values["train/qf_learning_rate"], values["train/lam"]) == (0.25, 0.5)
                assert all(type(value) in (int, float) for value in values.values())
                assert "train/critic_loss" in values
                assert ("train/actor_loss" in values) == (self.model._n_updates > 1)
            return True

    model.learn(100, callback=Reads(), log_interval=3)
    assert rates == pytest.approx([1 - n / 100 for n in range(11, 100)])
    values = model.logger.name_to_value
    expected = {"actor_loss", "critic_loss", "n_updates", "learning_rate", "td_error_var", "critic_2_selected"}
    expected |= {"ent_coef", "ent_coef_loss", "entropy"} if stochastic_actor else set()
    assert expected <= {name.removeprefix("train/") for name in values}


def test_a_logger_that_a_callback_keeps_has_the_losses():
    model = make()
    logger = configure(None, [])
    model.set_logger(logger)
    model.learn(40, log_interval=None)
    assert logger.name_to_value["train/n_updates"] == 30
    assert logger.name_to_value["train/actor_loss"] != 0


class OnAnotherDevice(TDC):
    """Pretends that its tensors are on a device that must not be waited for."""

    def _record_training(self):
        cpu, self.device = self.device, th.device("meta")
        super()._record_training()
        self.device = cpu


def test_no_update_waits_for_the_device(monkeypatch):
    fetched = []
    model = OnAnotherDevice("MlpPolicy", TwoActions(), learning_starts=10, buffer_size=100, device="cpu")
    collect = model._diagnostics._collect
    monkeypatch.setattr(model._diagnostics, "_collect", lambda: fetched.append(model._n_updates) or collect())
    logger = configure(None, [])
    model.set_logger(logger)
    model.learn(60, log_interval=None)
    assert fetched == []
    assert logger.name_to_value["train/n_updates"] == 50  # known here without waiting
    assert "train/actor_loss" not in logger.name_to_value
    assert model.logger.name_to_value["train/actor_loss"] != 0  # read, and so fetched
    assert fetched == [50]
    assert model.logger.name_to_value["train/critic_loss"] > 0
    assert fetched == [50]  # nothing has come since


def test_means_are_those_since_the_last_entry():
    model = make()
    model._logger = configure(None, [])
    model.learn(11)

    def add(**values):
        model._n_updates += 1
        model.diagnose(**{name: th.tensor(value) for name, value in values.items()})
        model._record_training()

    model.dump_logs()
    add(actor_loss=1.0, critic_loss=8.0)
    add(actor_loss=3.0)
    assert model.logger.name_to_value["train/actor_loss"] == 2.0
    model.dump_logs()
    assert "train/actor_loss" not in model.logger.name_to_value
    add(actor_loss=7.0)
    assert model.logger.name_to_value["train/actor_loss"] == 7.0
    # No loss of the critics since the entry: the last known one, not SB3's default of 0
    assert model.logger.name_to_value["train/critic_loss"] == 8.0
    add(critic_loss=2.0)
    assert model.logger.name_to_value["train/critic_loss"] == 2.0


def test_every_writer_of_sb3_writes_the_entries_of_evaluations_too(tmp_path):
    model = make(gradient_steps=DIAGNOSTICS_INTERVAL)
    model.set_logger(configure(str(tmp_path), ["csv", "json", "log", "tensorboard"]))
    evaluation = EvalCallback(make_vec_env(TwoActions), eval_freq=25, n_eval_episodes=1, verbose=0)
    model.learn(30, callback=evaluation)
    model.dump_logs()
    model.logger.close()
    rows = list(csv.DictReader((tmp_path / "progress.csv").read_text().splitlines()))
    lines = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    (row,) = [row for row in rows if row["eval/mean_reward"]]
    (line,) = [line for line in lines if "eval/mean_reward" in line]
    assert float(row["train/critic_loss"]) == line["train/critic_loss"] > 0
    assert line["train/n_updates"] == 14 * DIAGNOSTICS_INTERVAL  # steps 11 to 24
    assert "critic_loss" in (tmp_path / "log.txt").read_text()
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert 25 in [event.step for event in events.Scalars("train/critic_loss")]
    assert "train/n_updates" not in events.Tags()["scalars"]


def test_the_log_is_pickled():
    model = make()
    model.learn(30)
    assert pickle.loads(pickle.dumps(dict(model.logger.name_to_value)))["train/n_updates"] == 20


def test_a_loss_that_is_not_finite_is_named_at_its_update():
    model = make(TwoActions, policy_delay=1)
    model.learn(30)
    with th.no_grad():
        model.critic.layers[0].weight.fill_(th.nan)
    with pytest.raises(NonFiniteError, match=r"actor_loss is nan since update 21 .* last seen finite at update 20"):
        model.train(1, 16)


def test_it_saves_to_a_stream_what_it_reads_back():
    stream = io.BytesIO()
    make(stochastic_actor=True, ent_coef=0.5).save(stream)
    assert TDC.load(io.BytesIO(stream.getvalue()), ent_coef=0.25).current_ent_coef().item() == 0.25


@pytest.mark.parametrize("algorithm", [TDC, MEOW])
@pytest.mark.parametrize("method", ["learn", "load", "save"])
def test_methods_take_what_those_of_sb3_take(algorithm, method):
    own, of_sb3 = (inspect.signature(getattr(cls, method)).parameters for cls in (algorithm, OffPolicyAlgorithm))
    assert list(own) == list(of_sb3)
    for name in of_sb3.keys() - {"tb_log_name"}:
        assert (own[name].default, own[name].kind) == (of_sb3[name].default, of_sb3[name].kind), name
