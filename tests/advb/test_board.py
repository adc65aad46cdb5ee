"""The advisory board: its members, its actions, and that it is saved and loaded with its model."""

import inspect

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_tdc import load_safely
from sb3_tdc.advb import AdvBSAC, AdvBTD3, AdvBTDC, BoardCallback
from tests.helpers.tdc import OBS, TwoActions

ALGORITHMS = pytest.mark.parametrize("algorithm", [AdvBTD3, AdvBSAC, AdvBTDC])


def make(algorithm=AdvBTD3, n_members=3, env=None, **kwargs):
    policy_kwargs = {"net_arch": [8, 8], "n_members": n_members}
    settings = {"learning_starts": 8, "batch_size": 8, "buffer_size": 300, "seed": 0, "device": "cpu", **kwargs}
    return algorithm("MlpPolicy", env or TwoActions(), policy_kwargs=policy_kwargs, **settings)


def perturb(network, seed):
    generator = th.Generator().manual_seed(seed)
    with th.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.5 * th.randn(parameter.shape, generator=generator))


def fill(model, returns):
    """
    Propose a new actor for every return.

    :return: the weights of each actor, by its return
    """
    actors = {}
    for seed, test_return in enumerate(returns):
        perturb(model.policy.actor, seed)
        actors[test_return] = {name: tensor.clone() for name, tensor in model.policy.actor.state_dict().items()}
        model.policy.board.propose(model.policy.actor, test_return)
    return actors


def observations(n=50):
    return np.random.default_rng(0).normal(size=(n, OBS)).astype(np.float32)


@ALGORITHMS
@pytest.mark.parametrize(
    ("returns", "expected"),
    [
        ([5.0], [5.0]),
        ([1.0, 2.0], [2.0, 1.0]),
        ([2.0, 1.0, 3.0, -4.0], [3.0, 2.0, 1.0]),  # −4 gets no seat
        ([1.0, 2.0, 3.0, 2.5], [3.0, 2.5, 2.0]),  # 1 loses its seat
        ([1.0, 2.0, 3.0, 9.0, 8.0], [9.0, 8.0, 3.0]),
        ([np.nan, 1.0, np.inf, 2.0, -np.inf], [2.0, 1.0]),  # no return would ever rank above NaN
    ],
)
def test_members_are_ordered_by_their_returns(algorithm, returns, expected):
    model = make(algorithm)
    actors = fill(model, returns)
    board = model.policy.board
    assert board.returns[: len(board)].tolist() == expected
    for member, test_return in zip(board.members, expected, strict=False):
        assert all(th.equal(tensor, actors[test_return][name]) for name, tensor in member.state_dict().items())


def test_an_equal_return_comes_after_those_that_were_there():
    board = make().policy.board
    actor = make().policy.actor
    assert [board.propose(actor, value) for value in (1.0, 1.0, 1.0, 1.0)] == [0, 1, 2, None]


def brute_force_score(model, obs, action):
    predictions = model.policy.critic(obs, action)
    if not isinstance(model, AdvBTDC):
        return min(float(q) for q in predictions)
    return min(float(z.mean()) - 3.0 * float(np.std(z.numpy())) for z in predictions[0])


@ALGORITHMS
def test_the_cooperative_action_is_the_best_by_brute_force(algorithm):
    model = make(algorithm, **({"lam": 3.0} if algorithm is AdvBTDC else {}))
    fill(model, [1.0, 3.0, 2.0])
    policy, obs = model.policy, th.tensor(observations())
    perturb(policy.critic, 7)
    with th.no_grad():
        chosen = policy._predict(obs, deterministic=True)
        members = set()
        for i in range(len(obs)):
            advice = [member._predict(obs[i : i + 1], deterministic=True) for member in policy.board.members]
            values = [brute_force_score(model, obs[i : i + 1], action) for action in advice]
            members.add(int(np.argmax(values)))
            assert th.allclose(chosen[i], advice[int(np.argmax(values))][0], atol=1e-6)
    assert len(members) > 1  # not always the same member


@ALGORITHMS
def test_a_board_of_one_is_the_actor_that_it_took(algorithm):
    model = make(algorithm, n_members=1)
    fill(model, [1.0])
    with model.policy.actor_alone():
        alone, _ = model.predict(observations(), deterministic=True)
    assert np.allclose(model.predict(observations(), deterministic=True)[0], alone, atol=1e-6)
    perturb(model.policy.actor, 5)  # a snapshot does not learn
    assert np.allclose(model.predict(observations(), deterministic=True)[0], alone, atol=1e-6)


@ALGORITHMS
def test_the_actor_can_act_without_its_board(algorithm):
    model, obs = make(algorithm), observations()
    fill(model, [3.0, 2.0, 1.0])
    perturb(model.policy.actor, 9)
    advised, _ = model.predict(obs, deterministic=True)
    with model.policy.actor_alone():
        alone, _ = model.predict(obs, deterministic=True)
        with model.policy.actor_alone():
            pass
        again, _ = model.predict(obs, deterministic=True)
    with th.no_grad():
        expected = model.policy.actor._predict(th.as_tensor(obs), deterministic=True)
    np.testing.assert_allclose(alone, model.policy.unscale_action(expected.numpy()), atol=1e-6)
    np.testing.assert_array_equal(again, alone)
    assert np.abs(advised - alone).max() > 0.01
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], advised)


@ALGORITHMS
def test_without_members_the_actor_acts(algorithm):
    model = make(algorithm)
    plain = algorithm.__bases__[1]  # SB3's class
    expected = plain.policy_aliases["MlpPolicy"]._predict(model.policy, th.tensor(observations()), deterministic=True)
    with th.no_grad():
        assert np.allclose(model.policy._predict(th.tensor(observations()), deterministic=True), expected.detach())
    with pytest.raises(ValueError, match="no members yet"):
        model.policy.board.cooperative_actions(th.tensor(observations()), model.policy.score)


def test_critics_and_members_are_in_evaluation_mode_when_the_board_acts(monkeypatch):
    model = make()
    fill(model, [1.0, 2.0])
    modes, score = [], model.policy.score

    def recording(obs, actions):
        modes.append(model.policy.critic.training)
        return score(obs, actions)

    monkeypatch.setattr(model.policy, "score", recording)
    model.policy.set_training_mode(True)
    model.predict(observations(), deterministic=True)
    assert modes == [False, False]
    assert not any(module.training for module in model.policy.board.members.modules())


class Watch(BaseCallback):
    """Records for every training episode whether the board was asked for an action."""

    def __init__(self, monkeypatch):
        super().__init__()
        self.monkeypatch, self.asked, self.current = monkeypatch, [], []

    def _on_training_start(self):
        score = self.model.policy.score

        def recording(*args):
            if not self.model.policy.actor_decides_alone:
                self.current.append(True)
            return score(*args)

        self.monkeypatch.setattr(self.model.policy, "score", recording)

    def _on_step(self):
        if self.locals["dones"][0]:
            self.asked.append(bool(self.current))
            self.current = []
        return True


@ALGORITHMS
@pytest.mark.parametrize("formation_period", [2, 10_000])
def test_the_board_acts_in_training_from_the_formation_period_on(monkeypatch, algorithm, formation_period):
    model = make(algorithm, formation_period=formation_period)
    watch, eval_env = Watch(monkeypatch), make_vec_env(TwoActions, 1)
    model.learn(40, callback=[BoardCallback(eval_env), watch])
    assert len(watch.asked) >= 6
    assert watch.asked == [i >= formation_period for i in range(len(watch.asked))]


def test_every_training_episode_is_followed_by_a_test_episode_of_the_actor_alone(tmp_path):
    model = make(env=make_vec_env(TwoActions, 2, seed=1), n_members=50)
    model.set_logger(configure(str(tmp_path), []))
    callback = BoardCallback(make_vec_env(TwoActions, 1, seed=2))
    model.learn(80, callback=callback, log_interval=None)
    assert model._episode_num > 10
    assert len(model.policy.board) == model._episode_num
    assert 5 * model._episode_num <= callback.test_steps <= 7 * model._episode_num  # episodes are 5 or 7 steps long
    assert callback.eval_env.envs[0].unwrapped.episode >= model._episode_num
    log = model.logger.name_to_value
    assert (log["board/test_steps"], log["board/members"]) == (callback.test_steps, model._episode_num)
    assert log["board/best_return"] == model.policy.board.returns[: len(model.policy.board)].max()


def test_test_episodes_use_the_statistics_of_the_training():
    env = VecNormalize(make_vec_env(TwoActions, 1, seed=1))
    eval_env = VecNormalize(make_vec_env(TwoActions, 1, seed=2), training=False, norm_reward=False)
    model = make(env=env)
    model.learn(40, callback=BoardCallback(eval_env))
    assert eval_env.obs_rms.count > 20  # its own count stays at 10⁻⁴: it does not train
    with pytest.raises(ValueError, match="one environment, got 2"):
        BoardCallback(make_vec_env(TwoActions, 2))


@ALGORITHMS
def test_test_episodes_may_be_monitored_outside_the_normalisation(algorithm):
    """Returns are then NumPy scalars, and the statistics are one wrapper further inside."""
    env, eval_env = (VecMonitor(VecNormalize(make_vec_env(TwoActions, 1, seed=seed))) for seed in (1, 2))
    make(algorithm, env=env).learn(40, callback=BoardCallback(eval_env))
    assert env.obs_rms.count - 7 <= eval_env.obs_rms.count <= env.obs_rms.count  # copied when the last episode ended


def test_returns_of_test_episodes_are_not_normalised():
    class Constant(TwoActions):
        def step(self, action):
            observation, _, *rest = super().step(action)
            return observation, -1.0, *rest

    env, eval_env = (VecNormalize(DummyVecEnv([Constant])) for _ in range(2))  # no Monitor with raw returns
    model = make(env=env, n_members=20)
    model.learn(40, callback=BoardCallback(eval_env))
    returns = model.policy.board.returns[: len(model.policy.board)].tolist()
    assert set(returns) == {-5.0}  # every second episode has 5 steps, and every test episode resets twice
    assert eval_env.obs_rms.count == pytest.approx(env.obs_rms.count, abs=10)  # the steps of test episodes do not count


@pytest.mark.parametrize("normalised", ["env", "eval_env"])
def test_one_normalised_environment_alone_is_refused(normalised):
    envs = {name: make_vec_env(TwoActions, 1) for name in ("env", "eval_env")}
    envs[normalised] = VecNormalize(envs[normalised])
    with pytest.raises(ValueError, match="eval_env must be wrapped as the training's environment, but only"):
        make(env=envs["env"]).learn(10, callback=BoardCallback(envs["eval_env"]))


@ALGORITHMS
def test_a_board_is_saved_and_opened_with_its_model(tmp_path, algorithm):
    model = make(algorithm, formation_period=7)
    fill(model, [1.0, 3.0])
    model.learn(20)
    model.save(tmp_path / "model.zip")
    expected, _ = model.predict(observations(), deterministic=True)
    for loaded in (algorithm.load(tmp_path / "model.zip"), load_safely(tmp_path / "model.zip", device="cpu")):
        assert type(loaded) is algorithm
        assert loaded.formation_period == 7
        assert loaded.policy.board.returns[:2].tolist() == [3.0, 1.0]
        assert len(loaded.policy.board) == 2
        assert np.array_equal(loaded.predict(observations(), deterministic=True)[0], expected)


@ALGORITHMS
def test_training_is_that_of_sb3_until_the_board_acts(algorithm):
    """The same seed gives the weights of SB3's algorithm, bit for bit, although a board is filled meanwhile."""
    settings = {"learning_starts": 8, "batch_size": 8, "buffer_size": 300, "seed": 0, "device": "cpu"}
    settings |= {"fused": False} if algorithm is AdvBTDC else {}  # as with any custom policy class

    def learned(model, callback=None):
        start = {name: weight.clone() for name, weight in model.policy.state_dict().items()}
        return start, model.learn(40, callback=callback).policy.state_dict()

    callback = BoardCallback(make_vec_env(TwoActions, 1, seed=1))  # it seeds the action space, which is the class's
    start, advised = learned(make(algorithm, **settings), callback)
    plain_class = algorithm.__bases__[1]
    plain_start, plain = learned(plain_class("MlpPolicy", TwoActions(), policy_kwargs={"net_arch": [8, 8]}, **settings))
    assert advised["board.n_taken"] > 0
    for name, weight in plain.items():
        assert th.equal(start[name], plain_start[name])
        assert th.equal(advised[name], weight)
    assert not all(th.equal(plain[name], weight) for name, weight in plain_start.items())  # it has learned


def test_the_board_of_tdc_scores_with_the_current_lam(tmp_path):
    model = make(AdvBTDC, lam=lambda left: left)
    assert model.policy.lam == 1.0
    model.learn(20)
    assert model.policy.lam == pytest.approx(0.0, abs=1e-6)
    model = make(AdvBTDC, lam=0.7)
    model.save(tmp_path / "model.zip")
    assert [load(tmp_path / "model.zip").policy.lam for load in (AdvBTDC.load, load_safely)] == [0.7, 0.7]
    model.policy.save(tmp_path / "policy.pth")
    assert type(model.policy).load(tmp_path / "policy.pth").lam == 0.7
    model.lam = 0.2
    model.predict(observations())
    assert model.policy.lam == 0.2


def test_a_subclass_may_have_any_constructor():
    class Extra(AdvBTD3):
        def __init__(self, policy, env, extra=1, **kwargs):
            super().__init__(policy, env, **kwargs)

    class Required(AdvBTDC):
        def __init__(self, extra, policy="MlpPolicy", env=None):
            super().__init__(policy, env)

    assert {"extra", "learning_rate", "formation_period"} <= set(inspect.signature(Extra).parameters)
    assert Extra("MlpPolicy", TwoActions()).formation_period == 10_000
    assert Required(3, env=TwoActions()).formation_period == 10_000


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [({"formation_period": -1}, "formation_period must be"), ({"n_members": 0}, "policy_kwargs.'n_members'. must be")],
)
def test_bad_arguments_are_one_sentence(arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        make(**arguments)


@pytest.mark.slow
def test_the_board_is_not_worse_than_its_best_member_by_far_on_pendulum():
    env = gym.make("Pendulum-v1")
    model = AdvBTD3("MlpPolicy", env, learning_starts=500, learning_rate=1e-3, seed=0, device="cpu")
    model.learn(6_000, callback=BoardCallback(make_vec_env("Pendulum-v1", 1, seed=1)))
    mean, _ = evaluate_policy(model, env, n_eval_episodes=10, warn=False)
    assert mean > -400


@ALGORITHMS
def test_help_shows_the_arguments_of_the_algorithm(algorithm):
    parameters = list(inspect.signature(algorithm).parameters)
    base = algorithm.__bases__[1]  # the first is the board
    assert parameters == [*inspect.signature(base).parameters, "formation_period"]
