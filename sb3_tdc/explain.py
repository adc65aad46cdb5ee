"""
What the critics of TDC predict, against the returns that follow: ``enjoy.py --explain RUN``, and TensorBoard.

Shapes: ``T`` steps of an episode, ``C`` critics, ``N`` quantiles. Predictions are of the critics at the state and the
mean action that is played.
"""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_tdc.plot import style_axes
from sb3_tdc.tdc import TDC
from sb3_tdc.tdc.quantiles import mean_and_std, quantile_midpoints, select_critic

# A return is known where at most this share of a discounted stream of rewards lies behind the end of what was played
TOLERANCE = 0.01
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
_STYLES = ("-", "--")  # so that critics that agree are both seen


def discounted_returns(rewards: np.ndarray, gamma: float) -> np.ndarray:
    """
    The discounted sum of the rewards from every step on, G_t = r_t + γ·G_{t+1}.

    :param rewards: (T,)
    :return: (T,); what would have come after the last reward is not in it
    """
    returns = np.empty(len(rewards))
    following = 0.0
    for step in reversed(range(len(rewards))):
        returns[step] = following = rewards[step] + gamma * following
    return returns


def known_steps(n_steps: int, terminated: bool, gamma: float, tolerance: float = TOLERANCE) -> int:
    """
    From how many first steps of an episode the whole discounted return has been seen.

    :param terminated: whether it ended by itself; after a time limit, rewards would have gone on
    :param tolerance: the largest weight γ^(T−t) of what was not seen
    :return: between 0 and ``n_steps``
    """
    if terminated:
        return n_steps
    return max(n_steps - steps_until_negligible(gamma, tolerance), 0) if gamma < 1 else 0


def steps_until_negligible(gamma: float, tolerance: float = TOLERANCE) -> int:
    """:return: the smallest n with γ^n at most ``tolerance``, for γ < 1"""
    return int(np.ceil(np.log(tolerance) / np.log(gamma))) if gamma > 0 else 1


def observed_frequency(quantiles: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """
    How often the return stayed at or below each predicted quantile: of a calibrated critic, as often as its level says.

    :param quantiles: (T, N)
    :param returns: (T,)
    :return: (N,), between 0 and 1
    """
    return (returns[:, None] <= quantiles).mean(axis=0)


@dataclass(frozen=True)
class Episode:
    """
    One episode and what was predicted on its way.

    :param steps: (M,), those that were looked at, in increasing order
    :param quantiles: (M, C, N), predicted returns
    :param selected: (M,), the critic that the target would take (Eq. 5)
    :param returns: (M,), realised discounted returns; NaN where too much of it was not seen
    """

    steps: np.ndarray
    quantiles: np.ndarray
    selected: np.ndarray
    returns: np.ndarray

    @property
    def means(self) -> np.ndarray:
        """(M, C)"""
        return self.quantiles.mean(axis=2)

    @property
    def stds(self) -> np.ndarray:
        """(M, C), population standard deviations (Eq. 4)"""
        return self.quantiles.std(axis=2)

    @property
    def overestimation(self) -> np.ndarray:
        """(M, C), predicted mean − realised return; NaN where that is not known"""
        return self.means - self.returns[:, None]

    @property
    def frequencies(self) -> np.ndarray:
        """(C, N), see :func:`observed_frequency`; NaN if no return is known"""
        known = np.isfinite(self.returns)
        if not known.any():
            return np.full(self.quantiles.shape[1:], np.nan)
        critics = self.quantiles[known].transpose(1, 0, 2)
        return np.stack([observed_frequency(quantiles, self.returns[known]) for quantiles in critics])


def summarise(episodes: Sequence[Episode]) -> dict[str, float]:
    """
    :return: ``overestimation`` (mean over steps and critics, in units of the critics' return) and
        ``calibration_error`` (mean over levels and critics of |observed − nominal|, between 0 and 0.5 or so), every
        episode with the same weight; without episodes of known returns, nothing
    """
    known = [episode for episode in episodes if np.isfinite(episode.returns).any()]
    if not known:
        return {}
    frequencies = np.mean([episode.frequencies for episode in known], axis=0)
    levels = quantile_midpoints(frequencies.shape[1]).numpy()
    return {
        "overestimation": float(np.mean([np.nanmean(episode.overestimation) for episode in known])),
        "calibration_error": float(np.abs(frequencies - levels).mean()),
    }


class Recording:
    """
    Collects the steps of an episode, and at its end asks the critics about them all at once.

    :param model: its critics, γ and λ
    :param every: look at every so many steps; rewards of all are needed
    :param normalization: what turns the rewards into those that the critics were trained on, if they are not yet
    """

    def __init__(self, model: TDC, every: int = 1, normalization: VecNormalize | None = None):
        self.model, self.every, self.normalization = model, every, normalization
        self.start()

    def start(self) -> None:
        """Begin an episode."""
        self.rewards: list[float] = []
        self.observations: list[Any] = []
        self.actions: list[np.ndarray] = []

    def add(self, observation: Any, action: np.ndarray, reward: float) -> None:
        """
        :param observation: without a batch axis, as the policy saw it
        :param action: (A,)
        :param reward: as the environment gave it
        """
        if len(self.rewards) % self.every == 0:
            self.observations.append(observation)
            self.actions.append(action)
        self.rewards.append(reward)

    def finish(self, terminated: bool, n_shown: int | None = None) -> Episode:
        """
        :param terminated: whether the episode ended by itself
        :param n_shown: leave out the steps after so many
        """
        n_steps = len(self.rewards)
        rewards = np.asarray(self.rewards)
        if self.normalization is not None:
            rewards = self.normalization.normalize_reward(rewards)  # as they are, if it does not normalise rewards
        returns = discounted_returns(rewards, self.model.gamma)
        returns[known_steps(n_steps, terminated, self.model.gamma) :] = np.nan
        steps = np.arange(0, n_steps, self.every)
        steps = steps[: np.searchsorted(steps, n_shown)] if n_shown is not None else steps
        quantiles = predict_quantiles(self.model, self.observations[: len(steps)], np.stack(self.actions[: len(steps)]))
        mean, std = mean_and_std(quantiles)
        selected = select_critic(mean, std, self.model._scheduled("lam"))
        return Episode(steps, quantiles.numpy().astype(float), selected.numpy(), returns[steps])


def predict_quantiles(
    model: TDC, observations: Sequence[Any], actions: np.ndarray, batch_size: int = 1024
) -> th.Tensor:
    """
    :param observations: T of them, without a batch axis; arrays or dicts of arrays
    :param actions: (T, A), as given to the environment
    :return: (T, C, N) quantiles of the critics, on the CPU
    """
    policy = model.policy
    policy.set_training_mode(False)
    predicted = []
    for begin in range(0, len(observations), batch_size):
        some = observations[begin : begin + batch_size]
        stacked = {k: np.stack([o[k] for o in some]) for k in some[0]} if isinstance(some[0], dict) else np.stack(some)
        with th.no_grad():
            scaled = th.as_tensor(policy.scale_action(actions[begin : begin + batch_size]), device=model.device)
            predicted.append(policy.critic(policy.obs_to_tensor(stacked)[0], scaled.float().flatten(1)).cpu())
    return th.cat(predicted)


def play_episodes(model: TDC, env: VecEnv, n_episodes: int, limit: int | None = None) -> list[Episode]:
    """
    Play the mean action in one environment.

    :param env: whose rewards are those that the critics were trained on
    :param limit: leave out the steps after so many; the rewards there still count
    """
    recording = Recording(model)
    episodes: list[Episode] = []
    observation: Any = env.reset()
    while len(episodes) < n_episodes:
        action, _ = model.predict(observation, deterministic=True)
        single = {k: v[0] for k, v in observation.items()} if isinstance(observation, dict) else observation[0]
        observation, rewards, dones, infos = env.step(action)
        recording.add(single, action[0], float(rewards[0]))
        if dones[0]:
            episodes.append(recording.finish(not infos[0].get("TimeLimit.truncated", False), limit))
            recording.start()
    return episodes


def draw_fan(axes: Any, episode: Episode, critic: int) -> None:
    """Predicted quantiles of one critic along an episode (bands of 50 % and 90 %) and the realised return."""
    quantiles, color = episode.quantiles[:, critic], _COLORS[critic % len(_COLORS)]
    for share, alpha in ((0.9, 0.2), (0.5, 0.35)):
        low, high = np.quantile(quantiles, [0.5 - share / 2, 0.5 + share / 2], axis=1)
        axes.fill_between(episode.steps, low, high, color=color, alpha=alpha, lw=0, label=f"{share:.0%} predicted")
    axes.plot(episode.steps, np.median(quantiles, axis=1), color=color, lw=1, label="median")
    axes.plot(episode.steps, episode.returns, color="black", lw=1.2, label="realised")
    style_axes(axes, f"Critic {critic + 1}, first episode", "step", "discounted return")
    axes.legend(frameon=False, fontsize="small", ncols=2)


def draw_selection(axes: Any, episode: Episode) -> None:
    """σ of every critic along an episode; dots mark the critic that is selected."""
    for critic, std in enumerate(episode.stds.T):
        color = _COLORS[critic % len(_COLORS)]
        chosen = episode.selected == critic
        label = f"critic {critic + 1}, selected in {chosen.mean():.0%}"
        axes.plot(episode.steps, std, color=color, lw=0.7, alpha=0.6)
        axes.plot(episode.steps[chosen], std[chosen], ".", ms=2.5, color=color, label=label)
    style_axes(axes, "Selected critic, first episode", "step", "σ of the predicted return")
    axes.legend(frameon=False, fontsize="small", markerscale=4)


def draw_calibration(axes: Any, episodes: Sequence[Episode]) -> None:
    """Observed frequency against nominal level, a thin line for each episode and a thick one for their mean."""
    known = [episode for episode in episodes if np.isfinite(episode.returns).any()]
    axes.plot([0, 1], [0, 1], ":", color="grey", lw=1)
    for critic in range(episodes[0].quantiles.shape[1]):
        color = _COLORS[critic % len(_COLORS)]
        lines = [episode.frequencies[critic] for episode in known]
        levels = quantile_midpoints(episodes[0].quantiles.shape[2]).numpy()
        for line in lines:
            axes.plot(levels, line, color=color, lw=0.6, alpha=0.4)
        if len(lines):
            axes.plot(
                levels, np.mean(lines, axis=0), _STYLES[critic % 2], color=color, lw=1.8, label=f"critic {critic + 1}"
            )
    style_axes(axes, f"Calibration, {_count(known)}", "quantile level", "returns at or below the quantile")
    axes.set(xlim=(0, 1), ylim=(-0.02, 1.02))
    if known:
        axes.legend(frameon=False, fontsize="small")


def draw_overestimation(axes: Any, episodes: Sequence[Episode]) -> None:
    """Predicted mean − realised return along the episodes, one thin line for each and critic."""
    axes.axhline(0, color="grey", ls=":", lw=1)
    for critic in range(episodes[0].quantiles.shape[1]):
        color = _COLORS[critic % len(_COLORS)]
        biases = [episode.overestimation[:, critic] for episode in episodes]
        for episode, bias in zip(episodes, biases, strict=True):
            axes.plot(episode.steps, bias, color=color, lw=0.7, alpha=0.5)
        means = [np.nanmean(bias) for bias in biases if np.isfinite(bias).any()]
        if means:
            axes.axhline(
                np.mean(means),
                ls=_STYLES[critic % 2],
                color=color,
                lw=1.8,
                label=f"critic {critic + 1}: {np.mean(means):+.3g}",
            )
    style_axes(axes, f"Overestimation, {_count(episodes)}", "step", "predicted mean − realised")
    if any(np.isfinite(episode.returns).any() for episode in episodes):
        axes.legend(frameon=False, fontsize="small")


def make_figure(episodes: Sequence[Episode], title: str, note: str = "") -> Any:
    """
    All of the above on one page.

    :return: a figure of matplotlib
    :raises ImportError: with the command that installs it
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('Figures need matplotlib: pip install "sb3-tdc[plot]"') from error
    n_critics = episodes[0].quantiles.shape[1]
    rows = -(-(n_critics + 3) // 2)
    figure = Figure(figsize=(11, 3.2 * rows + 0.6), layout="constrained")
    axes = list(figure.subplots(rows, 2, squeeze=False).ravel())
    for critic in range(n_critics):
        draw_fan(axes[critic], episodes[0], critic)
    draw_selection(axes[n_critics], episodes[0])
    draw_calibration(axes[n_critics + 1], episodes)
    draw_overestimation(axes[n_critics + 2], episodes)
    for unused in axes[n_critics + 3 :]:
        unused.axis("off")
        unused.text(0, 0.95, note, va="top", fontsize="small").set_in_layout(False)
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
    return figure


def render(figure: Any) -> np.ndarray:
    """:return: (height, width, 3) pixels of a figure"""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def describe_play(model: TDC) -> str:
    """What one must know to read the figures."""
    target = "samples of the tanh-Gaussian" if model.stochastic_actor else "the mean action with smoothing noise"
    paragraphs = (
        f"Played: the mean action, without noise. The critics are trained for another policy, {target}, without "
        "entropy, and towards the one with the smaller μ − λσ: even perfect ones need not be calibrated for what is "
        "played.",
        "Realised: the discounted return from a step on. A time limit does not end it: play goes on behind it until "
        f"the discount is below {TOLERANCE:.0%}. Where less was seen, there is no line.",
        "The steps of one episode share most of their return. An episode is nearer to one observation than to a "
        "thousand, and a few do not settle calibration. Thin lines: single episodes.",
    )
    return "\n\n".join(textwrap.fill(paragraph, 78) for paragraph in paragraphs)


def write_explanation(model: TDC, episodes: Sequence[Episode], stem: Path, title: str) -> None:
    """Write the figure as PNG and PDF, and print what it shows in numbers."""
    figure = make_figure(episodes, title, describe_play(model))
    for suffix in (".png", ".pdf"):
        figure.savefig(f"{stem}{suffix}", dpi=150)
    for name, value in summarise(episodes).items():
        print(f"{name.replace('_', ' ').capitalize()}: {value:.4g} ({_count(episodes)})")
    if not summarise(episodes):
        print("No discounted return is known: the episodes end by a time limit before the discount has faded.")
    print(f"Wrote {stem}.png and .pdf")


def _count(episodes: Sequence[Episode]) -> str:
    return f"{len(episodes)} episode{'s' * (len(episodes) != 1)}"
