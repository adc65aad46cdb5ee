"""The critics' predictions against the returns that follow: by hand, then on a task whose returns are known."""

import csv

import gymnasium as gym
import numpy as np
import pytest
import scipy.stats
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_tdc import TDC
from sb3_tdc.cli import enjoy, train
from sb3_tdc.common.plots import import_figure
from sb3_tdc.critics import episodes as explain
from sb3_tdc.critics import figures, returns
from sb3_tdc.runs.callbacks import critic_evaluation
from sb3_tdc.runs.callbacks.stopping import StopOnSignalCallback
from sb3_tdc.tdc.quantiles import select_critic

REWARDS = st.lists(st.floats(-100, 100), min_size=1, max_size=30)


class Corridor(gym.Env):
    """A task with reward 1 at every step, whatever the action; it terminates after ``length`` steps."""

    observation_space = gym.spaces.Box(0, 1, (1,), dtype=np.float32)
    action_space = gym.spaces.Box(-2, 2, (1,), dtype=np.float32)

    def __init__(self, length):
        self.length, self.step_count = length, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.step_count = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.step_count += 1
        observation = np.array([self.step_count / 100 % 1], np.float32)
        return observation, 1.0, self.step_count >= self.length, False, {}


def make_env(length, limit=10_000):
    return DummyVecEnv([lambda: gym.wrappers.TimeLimit(Corridor(length), limit)])


def make_model(env, **kwargs):
    return TDC("MlpPolicy", env, gamma=0.9, seed=0, policy_kwargs={"net_arch": [8], "n_quantiles": 4}, **kwargs)


def test_discounted_returns_by_hand():
    # G_2 = 4, G_1 = 2 + 0.5·4 = 4, G_0 = 1 + 0.5·4 = 3
    assert returns.discounted_returns(np.array([1.0, 2.0, 4.0]), 0.5).tolist() == [3, 4, 4]


@given(REWARDS, st.floats(0, 1))
def test_discounted_returns_are_the_sums(rewards, gamma):
    sums = [sum(gamma**i * r for i, r in enumerate(rewards[step:])) for step in range(len(rewards))]
    np.testing.assert_allclose(returns.discounted_returns(np.array(rewards), gamma), sums, atol=1e-6)


def test_a_truncated_episode_is_known_where_its_tail_weighs_nothing():
    # 0.5^7 = 0.0078 is the first power of at most 0.01. What follows step 10 weighs 0.5^7 in the return from step 3 on,
    # 0.5^6 in that from step 4 on: the steps 0, 1, 2, 3 count
    assert returns.steps_until_negligible(0.5) == 7
    assert returns.known_steps(10, terminated=False, gamma=0.5) == 4
    assert returns.known_steps(5, terminated=False, gamma=0.5) == 0
    assert returns.known_steps(10, terminated=True, gamma=0.5) == 10
    assert returns.known_steps(10, terminated=False, gamma=1.0) == 0
    assert returns.known_steps(10, terminated=False, gamma=0.0) == 10


def test_near_the_time_limit_no_step_counts_however_the_episode_ends():
    # 0.5^7 is negligible: of a task with a limit of 10 steps, the first 4 count
    assert returns.known_steps(10, terminated=False, gamma=0.5, limit=10) == 4
    assert returns.known_steps(9, terminated=True, gamma=0.5, limit=10) == 4
    assert returns.known_steps(2, terminated=True, gamma=0.5, limit=10) == 2
    assert returns.known_steps(5, terminated=True, gamma=0.5, limit=6) == 0
    assert returns.known_steps(12, terminated=False, gamma=0.5, limit=20) == 6  # truncated, but not by the limit
    assert returns.known_steps(5, terminated=True, gamma=1.0) == 5
    assert returns.known_steps(5, terminated=True, gamma=1.0, limit=10) == 0


def test_observed_frequency_by_hand():
    quantiles = np.array([[0.0, 1.0, 2.0], [0.0, 1.0, 2.0]])
    # 1 lies at or below the second and third, 3 above all of them
    assert explain.observed_frequency(quantiles, np.array([1.0, 3.0])).tolist() == [0, 0.5, 0.5]


def test_right_quantiles_are_calibrated_and_moved_ones_are_not():
    rng = np.random.default_rng(0)
    levels = (np.arange(9) + 0.5) / 9
    quantiles = np.tile(-np.log(1 - levels), (50_000, 1))  # of the exponential distribution
    returns = rng.exponential(size=50_000)

    def summary(shift):
        z = (quantiles + shift)[:, None]
        return explain.summarise([explain.Episode(np.arange(50_000), z, np.zeros(50_000, int), returns)])

    assert summary(0.0)["calibration_error"] < 0.01
    assert summary(10.0)["calibration_error"] == pytest.approx(0.5, abs=1e-3)  # all below all quantiles: mean of 1 − τ
    assert summary(10.0)["overestimation"] - summary(0.0)["overestimation"] == pytest.approx(10)


def test_rank_correlation_by_hand():
    # Ranks 0 1 2 3 and 0 2 1 3: 1 − 6·Σd²/(n(n² − 1)) = 1 − 6·2/60
    assert explain.rank_correlation(np.array([1.0, 2, 5, 9]), np.array([-3.0, 8, 7, 100])) == pytest.approx(0.8)
    assert explain.rank_correlation(np.arange(5.0), -np.arange(5.0)) == pytest.approx(-1)
    assert np.isnan(explain.rank_correlation(np.arange(5.0), np.ones(5)))


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=3, max_size=30))
def test_rank_correlation_is_scipy_s(pairs):
    x, y = np.array(pairs, dtype=float).T  # with many ties
    found = explain.rank_correlation(x, y)
    if np.ptp(x) > 0 and np.ptp(y) > 0:
        assert found == pytest.approx(scipy.stats.spearmanr(x, y).statistic, abs=1e-12)


def test_spread_that_means_uncertainty_and_spread_that_does_not():
    rng = np.random.default_rng(0)
    std = rng.uniform(0.5, 5, 4_000)
    quantiles = std[:, None, None] * np.array([-1.0, 1.0])  # mean 0, population σ = std
    for error, expected in ((std * rng.normal(size=4_000), 0.5), (rng.normal(size=4_000), 0.0)):
        episode = explain.Episode(np.arange(4_000), quantiles, np.zeros(4_000, int), error)
        found = explain.summarise([episode])["std_error_correlation"]
        assert found == pytest.approx(scipy.stats.spearmanr(std, np.abs(error)).statistic, abs=1e-9)
        assert found == pytest.approx(expected, abs=0.1)


def test_a_bias_that_grows_with_the_value_hides_what_spread_means():
    """σ is the standard deviation of the returns, but the predictions are half of what they should be."""
    rng = np.random.default_rng(0)
    mean, std = rng.uniform(10, 100, 4_000), rng.uniform(0.5, 5, 4_000)
    quantiles = 0.5 * mean[:, None, None] + std[:, None, None] * np.array([-1.0, 1.0])
    returns = mean + std * rng.normal(size=4_000)
    episode = explain.Episode(np.arange(4_000), quantiles, np.zeros(4_000, int), returns)
    _, error, scatter = explain.spread_and_errors(episode)
    slope, offset = np.polyfit(0.5 * mean, returns, 1)
    np.testing.assert_allclose(scatter[:, 0], np.abs(returns - offset - slope * 0.5 * mean), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(error[:, 0], np.abs(returns - 0.5 * mean))
    found = explain.summarise([episode])
    assert found["std_scatter_correlation"] > 0.4
    assert found["std_error_correlation"] < 0.2


def test_every_step_has_the_same_weight():
    def episode(length, error):
        quantiles = np.full((length, 2, 4), 10.0 + error)
        return explain.Episode(np.arange(length), quantiles, np.zeros(length, int), np.full(length, 10.0))

    found = explain.summarise([episode(10, 5.0), episode(90, -1.0)])
    assert found["overestimation"] == pytest.approx((10 * 5 - 90) / 100)
    # Nine tenths of the returns are above all quantiles and a tenth below: 0.1 at each level of 1/8, 3/8, 5/8, 7/8
    assert found["calibration_error"] == pytest.approx(np.abs(0.1 - (np.arange(4) + 0.5) / 4).mean())


def test_what_lam_changes_is_drawn_as_the_choices_say():
    pytest.importorskip("matplotlib")
    rng = np.random.default_rng(0)
    quantiles = rng.normal(size=(50, 3, 6))
    episode = explain.Episode(np.arange(50), quantiles, np.zeros(50, int), np.full(50, np.nan))
    axes = import_figure()().subplots()
    figures.draw_lam(axes, [episode], lam=0.8)
    grid, shares = axes.lines[0].get_data()
    means, stds = th.tensor(episode.means), th.tensor(episode.stds)
    changed = [(select_critic(means, stds, lam) != means.argmin(dim=1)).double().mean() for lam in grid]
    np.testing.assert_allclose(shares, changed, atol=1e-9)
    assert 0 < shares[-1] < 1


def test_unknown_returns_do_not_count():
    quantiles = np.zeros((3, 2, 4)) + np.array([[[1.0]], [[2.0]], [[50.0]]])
    episode = explain.Episode(np.arange(3), quantiles, np.zeros(3, int), np.array([0.0, 0.0, np.nan]))
    assert explain.summarise([episode])["overestimation"] == pytest.approx(1.5)
    unknown = explain.Episode(np.arange(3), quantiles, np.zeros(3, int), np.full(3, np.nan))
    assert explain.summarise([unknown]) == {}
    assert explain.summarise([episode, unknown]) == explain.summarise([episode])


def test_unknown_returns_can_be_drawn():
    pytest.importorskip("matplotlib")
    unknown = explain.Episode(np.arange(3), np.zeros((3, 2, 4)), np.zeros(3, int), np.full(3, np.nan))
    figure = figures.make_figure([unknown], "title", lam=1.0)
    assert figures.render(figure).ndim == 3
    (calibration,) = (axes for axes in figure.axes if axes.get_title(loc="left").startswith("Calibration"))
    assert len(calibration.lines) == 1  # only the diagonal


def test_episodes_too_short_to_know_a_return_leave_no_trace_in_the_log(tmp_path, monkeypatch):
    """Pendulum's are: a time limit ends them after 200 steps."""
    monkeypatch.setattr(critic_evaluation, "_SHARE", 1e9)
    argv = ["--env", "Pendulum-v1", "-n", 60, "-f", tmp_path, "--eval-freq", 50, "--eval-episodes", 1, "--verbose", 0]
    assert train.main([str(a) for a in [*argv, "-params", "learning_starts:100"]]) == 0
    header = (tmp_path / "tdc" / "Pendulum-v1_1" / "progress.csv").read_text().splitlines()[0]
    assert "eval/mean_reward" in header
    assert "eval/overestimation" not in header


@pytest.mark.filterwarnings("ignore:You have specified an action space")
@pytest.mark.parametrize("shape", [(1,), (), (2, 3)])
def test_play_records_what_the_critics_say_about_the_action_that_is_played(monkeypatch, shape):
    monkeypatch.setattr(Corridor, "action_space", gym.spaces.Box(-2, 2, shape, dtype=np.float32))
    env = make_env(length=30)
    model = make_model(env, lam=0.5)
    (episode,) = explain.record_episodes(model, env, 1)
    np.testing.assert_allclose(episode.returns, (1 - 0.9 ** np.arange(30, 0, -1)) / 0.1)
    observation = np.array([0.07], np.float32)  # of step 7
    action, _ = model.predict(observation)
    scaled = model.policy.scale_action(action[None])
    with th.no_grad():
        expected = model.critic(th.as_tensor(observation[None]), th.as_tensor(scaled.reshape(1, -1)))[0].numpy()
    np.testing.assert_allclose(episode.quantiles[7], expected, rtol=1e-5)
    scores = expected.mean(axis=1) - 0.5 * expected.std(axis=1)
    assert episode.selected[7] == scores.argmin()


def test_play_goes_on_behind_the_time_limit_and_shows_what_lies_before():
    horizon = returns.steps_until_negligible(0.9)  # 44
    env = make_env(length=10_000, limit=20 + horizon)
    episodes = explain.record_episodes(make_model(env), env, 2, limit=20)
    for episode in episodes:
        assert len(episode.steps) == len(episode.quantiles) == 20
        np.testing.assert_allclose(episode.returns, 10, rtol=0.011)  # 1/(1 − γ), except for an unseen tail of 1 %


def test_rewards_are_those_that_the_critics_know():
    env = VecNormalize(make_env(length=5), training=False)
    env.ret_rms.var = np.float64(4.0)  # rewards are divided by 2
    model = make_model(env)
    (normalised,) = explain.record_episodes(model, env, 1)
    assert normalised.returns[-1] == pytest.approx(0.5, rel=1e-4)
    recording = explain.Recording(model, every=2, normalization=env)
    for _ in range(5):
        recording.add(np.zeros(1, np.float32), np.zeros(1, np.float32), 1.0)
    episode = recording.finish(terminated=True)
    assert episode.steps.tolist() == [0, 2, 4]
    np.testing.assert_allclose(episode.returns, normalised.returns[::2], rtol=1e-6)


def test_a_figure_of_any_number_of_critics():
    pytest.importorskip("matplotlib")
    env = make_env(length=10)
    model = TDC("MlpPolicy", env, policy_kwargs={"net_arch": [8], "n_quantiles": 4, "n_critics": 3})
    figure = figures.make_figure(explain.record_episodes(model, env, 2), "title", 1.0, figures.describe_play(model))
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == [
        *(f"Critic {i}, first episode" for i in (1, 2, 3)),
        "Selected critic, first episode",
        "Calibration, 2 episodes",
        "Overestimation, 2 episodes",
        "Does σ mean uncertainty? 2 episodes",
        "What λ changes, 2 episodes",
        *("", ""),  # the note, and empty axes
    ]
    height, width, channels = figures.render(figure).shape
    assert height > 100
    assert width > 100
    assert channels == 3


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of the stochastic head, with normalised rewards and two evaluation environments."""
    folder = tmp_path_factory.mktemp("logs")
    options = "policy_kwargs:{net_arch: [8], n_quantiles: 4}", "learning_starts:100", "batch_size:16", "normalize:true"
    argv = ["-n", 400, "--seed", 1, "-f", folder, "--eval-freq", 200, "--eval-episodes", 3, "--n-eval-envs", 2]
    argv += ["--env", "Hopper-v4", "--verbose", 0, "-params", *options, "stochastic_actor:true"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(critic_evaluation, "_SHARE", 1e9)  # draw figures however much of the time they take
        assert train.main([str(a) for a in argv]) == 0
    return folder / "tdc" / "Hopper-v4_1"


def test_evaluations_log_the_critics(run):
    (events,) = run.glob("events.out.tfevents.*")
    accumulator = EventAccumulator(str(events)).Reload()
    for name in ("overestimation", "calibration_error", "std_error_correlation", "std_scatter_correlation"):
        assert [event.step for event in accumulator.Scalars(f"eval/{name}")] == [200, 400]
    assert all(0 <= event.value <= 1 for event in accumulator.Scalars("eval/calibration_error"))
    assert [event.step for event in accumulator.Images("eval/critics")] == [200, 400]
    with (run / "progress.csv").open() as file:
        elapsed = [float(row["time/critics_elapsed"]) for row in csv.DictReader(file) if row["time/critics_elapsed"]]
    assert 0 < elapsed[0] < elapsed[-1] < 30


def test_a_figure_waits_until_it_takes_a_hundredth_of_the_time(tmp_path):
    argv = ["-n", 200, "-f", tmp_path, "--eval-freq", 100, "--eval-episodes", 1, "--env", "Hopper-v4", "--verbose", 0]
    assert train.main([str(a) for a in [*argv, "-params", "learning_starts:150"]]) == 0
    (events,) = (tmp_path / "tdc" / "Hopper-v4_1").glob("events.out.tfevents.*")
    accumulator = EventAccumulator(str(events)).Reload()
    tags = accumulator.Tags()
    # Nothing is logged at step 100, before the critics have learned anything
    assert [event.step for event in accumulator.Scalars("eval/overestimation")] == [200]
    assert tags["images"] == []  # a run of less than 200 s has no time even for the first, estimated at 2 s


def test_evaluations_hold_critics_against_the_normalised_returns(tmp_path, monkeypatch):
    """The recorded episodes equal those from playing them again."""
    seen = []
    monkeypatch.setattr(critic_evaluation, "summarise", lambda episodes: seen.append(episodes) or {})
    monkeypatch.setattr(critic_evaluation, "EVERY", 1)
    env, eval_env = (VecNormalize(make_env(length=12)) for _ in range(2))
    eval_env.training = eval_env.norm_reward = False
    model = make_model(env, gradient_steps=0)
    model._n_updates = 1
    model.learn(30, callback=critic_evaluation.CriticEvaluationCallback(
        eval_env, StopOnSignalCallback(), n_eval_episodes=2, eval_freq=30, verbose=0, warn=False
    ))  # fmt: skip
    (episodes,) = seen
    assert len(episodes) == 2
    env.training, env.norm_reward = False, True
    (expected,) = explain.record_episodes(model, env, 1)
    for episode in episodes:
        np.testing.assert_allclose(episode.returns, expected.returns, rtol=1e-5)
        np.testing.assert_allclose(episode.quantiles, expected.quantiles, rtol=1e-4, atol=1e-6)


def test_enjoy_explains_a_run(run, capsys):
    assert enjoy.main(["--explain", str(run), "--n-episodes", "2"]) == 0
    screen = capsys.readouterr().out
    assert "Overestimation: " in screen
    assert "Calibration error: " in screen
    for suffix in ("png", "pdf"):
        assert (run / f"Hopper-v4_critics.{suffix}").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--record", "x.mp4"], "leave out --record"),
        (["--stochastic"], "leave out --stochastic"),
        (["-n", "5"], "--explain needs whole episodes"),
    ],
)
def test_what_has_no_meaning_beside_explain_is_said(run, capsys, more, message):
    with pytest.raises(SystemExit):
        enjoy.main(["--explain", str(run), *more])
    assert message in capsys.readouterr().err
