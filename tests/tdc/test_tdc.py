"""TDC as an SB3 algorithm: wherever TD3, SAC and TQC work, saved and loaded, and with bad input."""

import copy
import io
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv, FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from torch import nn

from sb3_tdc import TDC, NonFiniteError
from sb3_tdc.tdc import MlpPolicy
from sb3_tdc.tdc.quantiles import Target
from sb3_tdc.tdc.tdc import DIAGNOSTICS_INTERVAL
from tests.helpers.tdc import HEADS, BatchNormExtractor, TwoActions, assert_same_weights, make, weights

# ---------------------------------------------------------------- where it must work


@HEADS
@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"env": TwoActions},
        {"n_envs": 3},
        {"n_envs": 3, "gradient_steps": -1},
        {"train_freq": (1, "episode"), "gradient_steps": 10},
        {"train_freq": (5, "step"), "gradient_steps": 3, "policy_delay": 3},
        {"n_steps": 3},
        {"n_steps": 3, "n_envs": 2},
        {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}},
        {"policy_kwargs": {"n_critics": 1}},
        {"policy_kwargs": {"n_critics": 4, "n_quantiles": 1}},
        {"policy_kwargs": {"net_arch": ()}},
        {"policy_kwargs": {"net_arch": {"pi": [8], "qf": (32, 32, 32)}}},
        {"policy_kwargs": {"activation_fn": nn.Tanh, "optimizer_class": th.optim.AdamW}},
        {"policy_kwargs": {"optimizer_class": th.optim.SGD, "optimizer_kwargs": {"momentum": 0.9}}},
        {"policy_kwargs": {"features_extractor_class": BatchNormExtractor}},
        {"policy_kwargs": {"features_extractor_class": BatchNormExtractor, "share_features_extractor": True}},
        {"action_noise": None},
        {"action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.2 * np.ones(1))},
        {"lam": LinearSchedule(1.0, 0.0, 1.0), "learning_rate": LinearSchedule(1e-3, 1e-4, 0.5)},
        {"ent_coef": "auto_0.1", "target_entropy": -0.5},
        {"ent_coef": 0.2},
    ],
    ids=str,
)
def test_it_runs(stochastic_actor, kwargs):
    kwargs = dict(kwargs)
    env = make_vec_env(kwargs.pop("env", "Pendulum-v1"), n_envs=kwargs.pop("n_envs", 1), seed=0)
    model = make(env, stochastic_actor=stochastic_actor, **kwargs)
    before = weights(model)
    model.learn(250)
    assert model._n_updates > 0
    assert all(weight.isfinite().all() for weight in model.policy.state_dict().values())
    assert any(not th.equal(before[k], w) for k, w in weights(model).items() if k.startswith("actor_target"))
    observation = env.observation_space.sample()
    assert env.action_space.contains(model.predict(observation)[0])


@HEADS
@pytest.mark.parametrize("wrapper", [VecNormalize, lambda env: VecFrameStack(env, 3)], ids=["normalize", "stack"])
def test_wrapped_environments(stochastic_actor, wrapper):
    env = wrapper(make_vec_env(TwoActions, n_envs=2, seed=0))
    make(env, stochastic_actor=stochastic_actor).learn(120)


@HEADS
@pytest.mark.parametrize("shared", [False, True], ids=["separate", "shared"])
def test_images(stochastic_actor, shared):
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False)
    model = make(
        env,
        "CnnPolicy",
        stochastic_actor=stochastic_actor,
        policy_kwargs={"features_extractor_kwargs": {"features_dim": 8}, "share_features_extractor": shared},
        learning_starts=10,
        buffer_size=60,
    )
    before = weights(model)
    model.learn(20)
    after = weights(model)
    # The critics' own extractor learns from the critics' loss; a shared one from the actor's
    for network in ("actor", "critic"):
        name = f"{network}.features_extractor.linear.0.weight"
        assert not th.equal(before[name], after[name])


@HEADS
def test_dictionaries_of_observations(stochastic_actor):
    env = SimpleMultiObsEnv(discrete_actions=False, random_start=False)
    model = make(env, "MultiInputPolicy", stochastic_actor=stochastic_actor, learning_starts=10, buffer_size=60)
    model.learn(20)


@HEADS
def test_hindsight(stochastic_actor):
    env = BitFlippingEnv(n_bits=4, continuous=True)
    model = make(
        env,
        "MultiInputPolicy",
        stochastic_actor=stochastic_actor,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 2, "goal_selection_strategy": "future"},
    )
    model.learn(150)


def test_running_statistics_reach_the_targets():
    model = make(policy_kwargs={"features_extractor_class": BatchNormExtractor}, policy_delay=1)
    model.learn(80)
    for online, target in ((model.actor, model.actor_target), (model.critic, model.critic_target)):
        statistics = online.features_extractor.net[1].running_mean
        assert statistics.abs().sum() > 0
        assert th.equal(statistics, target.features_extractor.net[1].running_mean)


def test_a_shared_extractor_is_averaged_once():
    model = make(policy_kwargs={"features_extractor_class": BatchNormExtractor, "share_features_extractor": True})
    model.tau = 0.25
    with th.no_grad():
        online = model.actor.features_extractor.net[1].weight.fill_(3.0)
        target = model.actor_target.features_extractor.net[1].weight.fill_(1.0)
    model.update_targets()
    assert online.unique().tolist() == [3.0]
    assert target.unique().tolist() == [1.5]


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
@HEADS
def test_cuda(stochastic_actor):
    make(stochastic_actor=stochastic_actor, device="cuda").learn(100)


# ---------------------------------------------------------------- actions


@HEADS
def test_actions_are_the_mean_action(stochastic_actor):
    model = make(TwoActions(), stochastic_actor=stochastic_actor)
    observations = np.random.default_rng(0).normal(size=(10, 3)).astype(np.float32)
    actions, _ = model.predict(observations, deterministic=False)
    assert np.array_equal(actions, model.predict(observations, deterministic=True)[0])
    tensor = th.from_numpy(observations)
    actor = model.actor
    normalised = th.tanh(actor.mu(actor.latent_pi(tensor))) if stochastic_actor else actor.mu(tensor)
    # Bounds −0.4 and 2: centre 0.8, half-width 1.2
    np.testing.assert_allclose(actions, 0.8 + 1.2 * normalised.detach().numpy(), rtol=1e-5, atol=1e-6)


def test_exploration_adds_noise_in_normalised_units():
    model = make(TwoActions(), learning_starts=0, action_noise=0.1)
    model._setup_learn(100)
    model._last_obs = np.zeros((1, 3), np.float32)
    mean = model.policy.scale_action(model.predict(model._last_obs)[0])
    samples = np.array([model._sample_action(0, model.action_noise)[1][0] for _ in range(3000)])
    np.testing.assert_allclose(samples.mean(axis=0), mean[0], atol=0.01)
    np.testing.assert_allclose(samples.std(axis=0), 0.1, atol=0.01)


def test_defaults_are_the_papers():
    model = TDC("MlpPolicy", "Pendulum-v1", device="cpu")
    assert (model.lam, model.kappa, model.policy_delay, model.gamma, model.tau) == (1.0, 1.0, 2, 0.99, 0.005)
    assert (model.target_policy_noise, model.target_noise_clip, model.batch_size) == (0.2, 0.5, 256)
    assert (model.learning_rate, model.buffer_size, model.stochastic_actor) == (3e-4, 1_000_000, False)
    assert isinstance(model.action_noise, NormalActionNoise)
    assert model.action_noise._sigma.tolist() == [0.1]
    assert [tuple(layer.weight.shape) for layer in model.critic.layers[::2]] == [
        (2, 4, 256),
        (2, 256, 256),
        (2, 256, 64),
    ]
    assert [layer.out_features for layer in model.actor.mu if isinstance(layer, nn.Linear)] == [256, 256, 1]


def test_critics_start_like_linear_layers_and_differ():
    critic = make(policy_kwargs={"net_arch": [256], "n_quantiles": 64}).critic
    first, last = critic.layers[0], critic.layers[-1]
    for layer, inputs in ((first, 4), (last, 256)):
        bound = 1 / inputs**0.5  # nn.Linear's
        assert layer.weight.abs().max() <= bound
        assert layer.weight.std().item() == pytest.approx(bound / 3**0.5, rel=0.1)
        assert not th.equal(layer.weight[0], layer.weight[1])


# ---------------------------------------------------------------- reproducibility


@HEADS
def test_same_seed_same_weights(stochastic_actor):
    runs = [weights(make(stochastic_actor=stochastic_actor, seed=7).learn(120)) for _ in range(2)]
    assert_same_weights(*runs)
    other = weights(make(stochastic_actor=stochastic_actor, seed=8).learn(120))
    assert any(not th.equal(weight, other[name]) for name, weight in runs[0].items())


def test_logging_does_not_change_the_training():
    class Dump(BaseCallback):
        def _on_step(self):
            self.model.dump_logs()
            return True

    assert_same_weights(weights(make().learn(120)), weights(make().learn(120, callback=Dump())))


@HEADS
@pytest.mark.parametrize("ent_coef", ["auto_0.3", 0.2])
def test_a_loaded_model_goes_on_as_if_it_had_not_stopped(tmp_path, stochastic_actor, ent_coef):
    """Saved at an odd update, so that the next one is a delayed one."""
    kwargs = {"stochastic_actor": stochastic_actor, "ent_coef": ent_coef, "qf_learning_rate": 1e-3, "kappa": 0.5}
    model = make(**kwargs)
    model.learn(91)
    assert model._n_updates == 51
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = TDC.load(tmp_path / "model", env=model.get_env())
    loaded.load_replay_buffer(tmp_path / "buffer")
    for continued in (model, loaded):
        continued._logger = Logger(None, [])
        np.random.seed(5)
        th.manual_seed(5)
        continued.train(gradient_steps=7, batch_size=16)
    assert loaded._n_updates == model._n_updates == 58
    assert_same_weights(weights(model), weights(loaded))
    for optimizer in ("actor.optimizer", "critic.optimizer", *(["ent_coef_optimizer"] if ent_coef != 0.2 else [])):
        if stochastic_actor or optimizer != "ent_coef_optimizer":
            a, b = model.get_parameters()[optimizer], loaded.get_parameters()[optimizer]
            th.testing.assert_close(a, b, rtol=0, atol=0)
    if stochastic_actor and ent_coef != 0.2:
        assert th.equal(model.log_ent_coef, loaded.log_ent_coef)
    assert loaded.lam == model.lam
    assert loaded.kappa == 0.5
    loaded.learn(60, reset_num_timesteps=False)  # with the noise and the schedules of the saved model


def test_loading_into_another_number_of_environments(tmp_path):
    make(make_vec_env("Pendulum-v1", n_envs=3)).learn(60).save(tmp_path / "model")
    TDC.load(tmp_path / "model", env=make_vec_env("Pendulum-v1", n_envs=1)).learn(60)
    assert TDC.load(tmp_path / "model").predict(np.zeros(3, np.float32))[0].shape == (1,)


@HEADS
def test_parameters_and_policies_travel_alone(tmp_path, stochastic_actor):
    model, other = make(stochastic_actor=stochastic_actor), make(stochastic_actor=stochastic_actor, seed=1)
    model.learn(60)
    other.set_parameters(model.get_parameters())
    assert_same_weights(weights(model), weights(other))
    model.policy.save(tmp_path / "policy.pt")
    policy = MlpPolicy.load(tmp_path / "policy.pt")
    observation = np.array([0.1, 0.2, 0.3], np.float32)
    assert np.array_equal(policy.predict(observation)[0], model.predict(observation)[0])


def test_a_schedule_survives_saving(tmp_path):
    make(lam=LinearSchedule(1.0, 0.5, 1.0)).save(tmp_path / "model")
    loaded = TDC.load(tmp_path / "model")
    loaded._current_progress_remaining = 0.5
    assert loaded.scheduled("lam") == pytest.approx(0.75)


# ---------------------------------------------------------------- logging


class Recorder(KVWriter):
    def __init__(self):
        self.entries = []

    def write(self, key_values, key_excluded, step=0):
        self.entries.append(copy.copy(key_values))

    def close(self):
        pass


@HEADS
def test_what_is_logged(stochastic_actor):
    model = make(stochastic_actor=stochastic_actor, lam=0.3, learning_rate=1e-3, qf_learning_rate=2e-3)
    recorder = Recorder()
    model.set_logger(Logger(None, [recorder]))
    model.learn(400, log_interval=1)
    entry = {k.removeprefix("train/"): v for k, v in recorder.entries[-1].items() if k.startswith("train/")}
    expected = {
        "actor_loss", "critic_1_selected", "critic_2_selected", "critic_disagreement", "critic_loss", "lam",
        "learning_rate", "n_updates", "qf_learning_rate", "target_mean", "target_std", "td_error_var",
        "lam_changes", "lam_adds", "lam_adds_in_std", "lam_can_change",
        "lam_critical_q10", "lam_critical_q50", "lam_critical_q90",
    }  # fmt: skip
    assert set(entry) == expected | ({"entropy", "ent_coef", "ent_coef_loss"} if stochastic_actor else set())
    assert (entry["lam"], entry["learning_rate"], entry["qf_learning_rate"]) == (0.3, 1e-3, 2e-3)
    assert entry["critic_1_selected"] + entry["critic_2_selected"] == pytest.approx(1.0)
    assert entry["n_updates"] == 400 - 40 - 1  # the last entry is written before the last update


def test_diagnostics_by_hand():
    model = make(kappa=1.0)
    model._n_updates = 1
    current = th.tensor([[[0.0, 2.0], [4.0, 4.0]], [[1.0, 1.0], [0.0, 6.0]]])  # (B, C, N)
    target = th.tensor([[1.0, 3.0], [0.0, 0.0]])
    mean, std = th.tensor([[1.0, 4.0], [5.0, 2.0]]), th.tensor([[0.5, 9.0], [9.0, 0.7]])
    model.diagnose_critics(current, Target(target, mean, std, selected=th.tensor([0, 1])))
    means = model._diagnostics.fetch()
    assert means["target_mean"] == pytest.approx(1.0)
    assert means["target_std"] == pytest.approx(0.6)  # of the selected: 0.5 and 0.7
    assert means["critic_disagreement"] == pytest.approx(3.0)
    assert means["critic_1_selected"] == means["critic_2_selected"] == 0.5
    # δ per critic: (2 − 1, 0 − 1) and (2 − 4, 0 − 3): variances 1 and 0.25
    assert means["td_error_var"] == pytest.approx(0.625)
    # κ = 1, levels 1/4, 3/4. Transition 1, critic 1: z = 0: δ 1, 3: L ½, 2.5, weight ¼; z = 2: δ −1, 1: L ½, ½,
    # weights ¼, ¾: (0.125 + 0.625 + 0.125 + 0.375) / 4 = 0.3125. Critic 2: z = 4: δ −3, −1: L 2.5, ½, weights ¾, ¼:
    # (1.875 + 0.375 + 0.625 + 0.125) / 4 = 0.75. Transition 2, critic 1: z = 1: δ −1, −1: (¾ + ¾ + ¼ + ¼) · ½ / 4
    # = 0.25. Critic 2: z = 0: 0; z = 6: δ −6: L 5.5, weight ¼, twice: 2.75 / 4 = 0.6875
    assert means["critic_loss"] == pytest.approx((0.3125 + 0.75 + 0.25 + 0.6875) / 2)


# ---------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"lam": -0.1}, r"lam must be a finite number of at least 0.0, got -0.1"),
        ({"lam": float("nan")}, "lam must be a finite number of at least 0.0, got nan"),
        ({"lam": "high"}, "lam must be .* got 'high'"),
        ({"lam": lambda progress: -progress}, r"lam \(a schedule, at progress remaining 1\) must be .* got -1.0"),
        ({"kappa": -1}, "kappa must be a finite number of at least 0.0, got -1"),
        ({"kappa": float("inf")}, "kappa must be .* got inf"),
        ({"learning_rate": float("nan")}, "learning_rate must be .* got nan"),
        ({"qf_learning_rate": -1e-3}, "qf_learning_rate must be .* got -0.001"),
        ({"policy_delay": 0}, "policy_delay must be an integer of at least 1, got 0"),
        ({"policy_delay": 1.5}, "policy_delay must be an integer of at least 1, got 1.5"),
        (
            {"policy_kwargs": {"n_quantiles": 0}},
            r"policy_kwargs\['n_quantiles'\] must be an integer of at least 1, got 0",
        ),
        (
            {"policy_kwargs": {"stochastic_actor": True}},
            "stochastic_actor must be an argument of TDC itself",
        ),
        ({"policy_kwargs": {"n_critics": 0}}, r"policy_kwargs\['n_critics'\] must be an integer of at least 1, got 0"),
        *(
            (
                {"policy_kwargs": {"net_arch": layers}},
                r"policy_kwargs.'net_arch'. must be a list of integers of at least 1, or a dict of .* pi and qf, got ",
            )
            for layers in (
                8,
                [0],
                [8, -1],
                [8.0],
                [True],
                ["a"],
                (8, 0),
                {"pi": [8]},
                {"pi": [8], "qf": 8},
                [{"pi": [8]}],
            )
        ),
        ({"tau": 1.5}, "tau must be a finite number between 0.0 and 1.0, got 1.5"),
        ({"gamma": -0.5}, "gamma must be .* got -0.5"),
        ({"batch_size": 0}, "batch_size must be .* got 0"),
        ({"train_freq": (0, "episode")}, "train_freq must be an integer of at least 1, got 0"),
        ({"stochastic_actor": "yes"}, "stochastic_actor must be True or False, got 'yes'"),
        ({"stochastic_actor": 1}, "stochastic_actor must be True or False, got 1"),
        ({"fused": "x"}, "fused must be True, False or None, got 'x'"),
        ({"optimize_memory_usage": None}, "optimize_memory_usage must be True or False, got None"),
        ({"gradient_steps": -2}, "gradient_steps must be an integer of at least -1, got -2"),
        ({"target_policy_noise": -0.2}, "target_policy_noise must be .* got -0.2"),
        ({"action_noise": -0.1}, "action_noise .* must be .* got -0.1"),
        ({"ent_coef": "automatic"}, 'ent_coef must be "auto", "auto_" .* got \'automatic\''),
        ({"ent_coef": "auto_0"}, "ent_coef must be .* got 'auto_0'"),
        ({"ent_coef": -0.1}, "ent_coef must be .* got -0.1"),
        ({"ent_coef": None, "stochastic_actor": True}, "ent_coef must be .* got None"),
        ({"train_freq": (1, "epoch")}, "unit of the `train_freq` must be either 'step' or 'episode' not 'epoch'"),
        ({"target_entropy": "low"}, "target_entropy .* got 'low'"),
        ({"env": "CartPole-v1"}, r"env must have a Box action space \(continuous actions\), got Discrete"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_bad_arguments_get_one_sentence(kwargs, message):
    with pytest.raises(ValueError, match=message) as error:
        make(**kwargs, buffer_size=10**15)  # no buffer could be made: the check comes before any work
    assert "\n" not in str(error.value)


def test_unbounded_actions_are_refused():
    class Unbounded(TwoActions):
        action_space = gym.spaces.Box(-np.inf, np.inf, (2,))

    with pytest.raises(ValueError, match="env must have a bounded action space"):
        make(Unbounded())

    class Degenerate(TwoActions):
        action_space = gym.spaces.Box(np.array([-1, 2]), np.array([1, 2]), dtype=np.float32)

    with pytest.raises(ValueError, match="low < high"):
        make(Degenerate())


def test_a_schedule_that_turns_bad_is_named():
    with pytest.raises(ValueError, match=r"lam \(a schedule, at progress remaining 0\.\d+\) must be .* got -1"):
        make(lam=lambda progress: 1.0 if progress > 0.5 else -1).learn(200)


def test_loading_with_a_bad_argument(tmp_path):
    make().save(tmp_path / "model")
    with pytest.raises(ValueError, match="lam must be"):
        TDC.load(tmp_path / "model", lam=-1.0)
    with pytest.raises(ValueError, match="stochastic_actor"):
        TDC.load(tmp_path / "model", stochastic_actor=True)


class Breaks(TwoActions):
    """Returns something that is not finite at one step."""

    def __init__(self, at, **broken):
        self.at, self.broken, self.count = at, broken, 0

    def step(self, action):
        observation, reward, *rest = super().step(action)
        self.count += 1
        if self.count == self.at:
            reward = self.broken.get("reward", reward)
            observation = observation * self.broken.get("observation", 1.0)
        return (observation, reward, *rest)


@pytest.mark.parametrize("broken", [{"reward": np.nan}, {"reward": np.inf}, {"observation": np.nan}], ids=str)
def test_a_broken_environment_stops_the_training(broken):
    model = make(DummyVecEnv([lambda: Breaks(57, **broken)]))
    (name,) = broken
    with pytest.raises(NonFiniteError, match=rf"The environment returned a non-finite {name} .* at timestep 57"):
        model.learn(100)
    assert model.replay_buffer.pos == 56
    assert all(weight.isfinite().all() for weight in model.policy.state_dict().values())


def test_a_last_observation_that_is_not_finite_is_not_stored():
    """A simulation that blows up ends its episode with NaN; what step() returns then is the next episode's start."""

    class BlowsUp(TwoActions):
        def step(self, action):
            observation, reward, terminated, truncated, info = super().step(action)
            return observation * (np.nan if terminated else 1.0), reward, terminated, truncated, info

    model = make(BlowsUp())
    with pytest.raises(NonFiniteError, match=r"returned a non-finite terminal observation .* at timestep 12 "):
        model.learn(100)
    assert model.replay_buffer.pos == 11


def test_a_diverged_loss_stops_the_training_and_spares_the_saved_model(tmp_path):
    path = tmp_path / "model.zip"
    model = make(learning_starts=40)
    model.learn(60)
    model.save(path)
    good = path.read_bytes()
    with th.no_grad():
        model.critic.layers[0].weight[0, 0, 0] = np.nan  # as if an update had overflowed
    with pytest.raises(NonFiniteError, match=r"is nan since update \d+ \(timestep \d+\); it was last seen finite at"):
        model.learn(60, reset_num_timesteps=False)
    with pytest.raises(NonFiniteError, match=r"step 62 was not saved: the weights actor\..* others are not finite"):
        model.save(path)
    assert path.read_bytes() == good


def test_a_loss_is_checked_even_if_nothing_is_logged():
    model = make(TwoActions(), gradient_steps=DIAGNOSTICS_INTERVAL)
    model.learn(60)
    model.replay_buffer.rewards[:] = np.inf  # the gradient of the Huber loss stays finite: only the value tells
    with warnings.catch_warnings(), pytest.raises(NonFiniteError, match="critic_loss is inf since update"):
        model.learn(5_000, log_interval=None, reset_num_timesteps=False)


def test_loading_with_the_policy_kwargs_of_the_user(tmp_path):
    kwargs = {"net_arch": [8], "n_quantiles": 3}
    model = TDC("MlpPolicy", "Pendulum-v1", policy_kwargs=kwargs, device="cpu", stochastic_actor=True)
    assert model.policy_kwargs == kwargs == {"net_arch": [8], "n_quantiles": 3}
    model.save(tmp_path / "model")
    assert TDC.load(tmp_path / "model", policy_kwargs=kwargs).stochastic_actor


def test_frozen_layers_stay(capsys):
    model = make(fused=False)
    model.actor.mu[0].weight.requires_grad_(False)
    before = weights(model)
    after = weights(model.learn(80))
    assert th.equal(before["actor.mu.0.weight"], after["actor.mu.0.weight"])
    assert not th.equal(before["actor.mu.2.weight"], after["actor.mu.2.weight"])


def test_it_saves_to_a_stream():
    stream = io.BytesIO()
    make().save(stream)
    assert TDC.load(io.BytesIO(stream.getvalue())).lam == 1.0
