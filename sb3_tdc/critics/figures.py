"""Figures of the episodes of :mod:`sb3_tdc.critics.episodes`, for ``sb3-tdc enjoy --explain`` and TensorBoard."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_tdc.common.plots import import_figure, style_axes
from sb3_tdc.common.words import count
from sb3_tdc.critics.episodes import Episode, pool, rank_correlation, spread_and_errors, summarise
from sb3_tdc.critics.returns import TOLERANCE
from sb3_tdc.tdc import TDC
from sb3_tdc.tdc.lam import critical_lam
from sb3_tdc.tdc.quantiles import quantile_midpoints

_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
_STYLES = ("-", "--")  # so that both lines are visible where critics agree


def draw_fan(axes: Any, episode: Episode, critic: int) -> None:
    """Draw the predicted quantiles of one critic along an episode (bands of 50 % and 90 %) and the realised return."""
    quantiles, color = episode.quantiles[:, critic], _COLORS[critic % len(_COLORS)]
    for share, alpha in ((0.9, 0.2), (0.5, 0.35)):
        low, high = np.quantile(quantiles, [0.5 - share / 2, 0.5 + share / 2], axis=1)
        axes.fill_between(episode.steps, low, high, color=color, alpha=alpha, lw=0, label=f"{share:.0%} predicted")
    axes.plot(episode.steps, np.median(quantiles, axis=1), color=color, lw=1, label="median")
    axes.plot(episode.steps, episode.returns, color="black", lw=1.2, label="realised")
    style_axes(axes, f"Critic {critic + 1}, first episode", "step", "discounted return")
    axes.legend(frameon=False, fontsize="small", ncols=2)


def draw_selection(axes: Any, episode: Episode) -> None:
    """Draw σ of every critic along an episode; dots mark the critic that is selected."""
    for critic, std in enumerate(episode.stds.T):
        color = _COLORS[critic % len(_COLORS)]
        chosen = episode.selected == critic
        label = f"critic {critic + 1}, selected in {chosen.mean():.0%}"
        axes.plot(episode.steps, std, color=color, lw=0.7, alpha=0.6)
        axes.plot(episode.steps[chosen], std[chosen], ".", ms=2.5, color=color, label=label)
    style_axes(axes, "Selected critic, first episode", "step", "σ of the predicted return")
    axes.legend(frameon=False, fontsize="small", markerscale=4)


def draw_calibration(axes: Any, episodes: Sequence[Episode]) -> None:
    """Draw observed frequency against nominal level: a thin line for each episode, a thick one for all their steps."""
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
                levels,
                pool(known).frequencies[critic],
                _STYLES[critic % 2],
                color=color,
                lw=1.8,
                label=f"critic {critic + 1}",
            )
    style_axes(
        axes, f"Calibration, {count(len(known), 'episode')}", "quantile level", "returns at or below the quantile"
    )
    axes.set(xlim=(0, 1), ylim=(-0.02, 1.02))
    if known:
        axes.legend(frameon=False, fontsize="small")


def draw_overestimation(axes: Any, episodes: Sequence[Episode]) -> None:
    """Draw predicted mean − realised return along the episodes, one thin line for each episode and critic."""
    axes.axhline(0, color="grey", ls=":", lw=1)
    for critic in range(episodes[0].quantiles.shape[1]):
        color = _COLORS[critic % len(_COLORS)]
        biases = [episode.overestimation[:, critic] for episode in episodes]
        for episode, bias in zip(episodes, biases, strict=True):
            axes.plot(episode.steps, bias, color=color, lw=0.7, alpha=0.5)
        known = pool(episodes).overestimation[:, critic]
        if len(known):
            mean = known.mean()
            label = f"critic {critic + 1}: {mean:+.3g}"
            axes.axhline(mean, ls=_STYLES[critic % 2], color=color, lw=1.8, label=label)
    style_axes(axes, f"Overestimation, {count(len(episodes), 'episode')}", "step", "predicted mean − realised")
    if any(np.isfinite(episode.returns).any() for episode in episodes):
        axes.legend(frameon=False, fontsize="small")


def draw_spread(axes: Any, episodes: Sequence[Episode]) -> None:
    """Draw |G − μ| against σ at every step, and their means over tenths of the steps: does σ mean uncertainty?"""
    pooled = pool(episodes)
    known = len(pooled.returns) > 0
    of_critics = [array.T for array in spread_and_errors(pooled)] if known else [np.empty((0, 0))] * 3
    for critic, (std, error, scatter) in enumerate(zip(*of_critics, strict=True)):
        color = _COLORS[critic % len(_COLORS)]
        axes.plot(std, error, ".", ms=1.5, color=color, alpha=0.3)
        tenths = np.array_split(np.argsort(std), 10) if len(std) >= 10 else []
        correlations = rank_correlation(std, error), rank_correlation(std, scatter)
        label = "critic {}, rank correlation {:+.2f}, without bias {:+.2f}".format(critic + 1, *correlations)
        means = np.array([(std[tenth].mean(), error[tenth].mean()) for tenth in tenths]).reshape(-1, 2)
        axes.plot(*means.T, _STYLES[critic % 2], color=color, lw=1.8, label=label)
    title = f"Does σ mean uncertainty? {count(len(episodes), 'episode')}"
    style_axes(axes, title, "σ of the predicted return", "|realised − predicted mean|")
    if known:
        axes.legend(frameon=False, fontsize="small")


def draw_lam(axes: Any, episodes: Sequence[Episode], lam: float) -> None:
    """Draw, against λ, the share of steps at which it selects a different critic than λ = 0 does."""
    pairs = [th.as_tensor(np.concatenate([getattr(e, name) for e in episodes])) for name in ("means", "stds")]
    thresholds = critical_lam(*pairs).numpy()
    grid = np.linspace(0, max(2.0, 1.5 * lam), 200)
    axes.plot(grid, (thresholds[:, None] < grid).mean(axis=0), color="black", lw=1.5)
    possible = np.isfinite(thresholds).mean()
    axes.axhline(possible, color="grey", ls=":", lw=1, label=f"any λ: {possible:.0%}")
    share = (thresholds < lam).mean()
    axes.axvline(lam, color=_COLORS[1], lw=1.2, label=f"λ = {lam:g}: {share:.0%}")
    style_axes(axes, f"What λ changes, {count(len(episodes), 'episode')}", "λ", "steps with another choice than λ = 0")
    axes.set(xlim=(0, grid[-1]), ylim=(-0.02, 1.02))
    axes.legend(frameon=False, fontsize="small")


def make_figure(episodes: Sequence[Episode], title: str, lam: float, note: str = "") -> Any:
    """
    Draw all of the above on one page.

    :param lam: the model's current λ
    :return: a Matplotlib figure
    :raises ImportError: if Matplotlib is missing, with the command that installs it
    """
    n_critics = episodes[0].quantiles.shape[1]
    rows = -(-(n_critics + 6) // 2)
    figure = import_figure()(figsize=(11, 3.2 * rows + 0.6), layout="constrained")
    axes = list(figure.subplots(rows, 2, squeeze=False).ravel())
    for critic in range(n_critics):
        draw_fan(axes[critic], episodes[0], critic)
    draw_selection(axes[n_critics], episodes[0])
    draw_calibration(axes[n_critics + 1], episodes)
    draw_overestimation(axes[n_critics + 2], episodes)
    draw_spread(axes[n_critics + 3], episodes)
    draw_lam(axes[n_critics + 4], episodes, lam)
    unused = axes[n_critics + 5 :]
    for empty in unused:
        empty.axis("off")
    unused[0].text(0, 0.95, note, va="top", fontsize="small").set_in_layout(False)
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
    return figure


def render(figure: Any) -> np.ndarray:
    """Return the pixels of a figure, (height, width, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def describe_play(model: TDC) -> str:
    """Return the notes that a reader of the figures needs."""
    target = "samples of the tanh-Gaussian" if model.stochastic_actor else "the mean action with smoothing noise"
    paragraphs = (
        f"Played: the mean action, without noise. The critics are trained for another policy, {target}, without "
        "entropy, and towards the one with the smaller μ − λσ: even perfect ones need not be calibrated for what is "
        "played.",
        "Realised: the discounted return from a step on. A time limit does not end it: play continues after it until "
        f"the discount is below {TOLERANCE:.0%}. Where less was seen, there is no line.",
        "The steps of one episode share most of their return. An episode is nearer to one observation than to a "
        "thousand, and a few do not settle calibration. Thin lines: single episodes.",
    )
    return "\n\n".join(textwrap.fill(paragraph, 78) for paragraph in paragraphs)


def write_explanation(model: TDC, episodes: Sequence[Episode], stem: Path, title: str) -> None:
    """Write the figure as PNG and PDF, and print its main numbers."""
    figure = make_figure(episodes, title, model.scheduled("lam"), describe_play(model))
    for suffix in (".png", ".pdf"):
        figure.savefig(f"{stem}{suffix}", dpi=150)
    for name, value in summarise(episodes).items():
        print(f"{name.replace('_', ' ').capitalize()}: {value:.4g} ({count(len(episodes), 'episode')})")
    if not summarise(episodes):
        print("No discounted return is known: the episodes end by a time limit before the discount has faded.")
    print(f"Wrote {stem}.png and .pdf")
