"""Figures of the paper: functions that draw arrays on axes of matplotlib, and read no file."""

import itertools
import textwrap
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sb3_tdc.common.plots import add_legend, short_number, style_axes
from sb3_tdc.common.words import count, counted
from sb3_tdc.experiments.published_curves import PublishedCurve
from sb3_tdc.experiments.statistics import mean_interval
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS

# Okabe and Ito's colours, which the colour-blind can tell apart
_OF_SB3 = {"TD3": "#D55E00", "SAC": "#009E73", "DDPG": "#CC79A7"}
COLORS: dict[str, str] = _OF_SB3 | {
    name.upper(): color
    for name, algorithm in KNOWN_ALGORITHMS.items()
    if (color := vars(algorithm).get("color")) is not None
}
OTHER_COLORS = ("#56B4E9", "#000000", "#8C564B", "#9467BD", "#BCBD22", "#17BECF")  # grey is for published curves


@dataclass(frozen=True)
class Curve:
    """
    One line of a figure.

    :param steps: (bins,), the last step of every bin
    :param values: (runs, bins), of the runs that are averaged
    :param unfinished: (runs, bins), of runs that are shown, but not averaged
    """

    label: str
    color: Any
    steps: np.ndarray
    values: np.ndarray
    unfinished: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))


def wrap(label: str, width: int) -> str:
    """Break a long label into at most three lines, and cut off the rest: the caption has the whole label."""
    return "\n".join(textwrap.wrap(label, width, max_lines=3, placeholder=" …"))


def colors_of(labels: Sequence[str]) -> list[str]:
    """
    Return a colour for each label of one figure.

    An algorithm with one label in the figure has its own colour, whatever its settings. If it has several labels, only
    the one without settings has that colour. All other labels take the remaining colours.
    """
    times = Counter(map(_algorithm, labels))
    names = {label: label if times[_algorithm(label)] > 1 else _algorithm(label) for label in labels}
    own = {label: COLORS[name] for label, name in names.items() if name in COLORS}
    others = itertools.cycle([color for color in OTHER_COLORS if color not in own.values()] or OTHER_COLORS)
    return [own[label] if label in own else next(others) for label in labels]


def _algorithm(label: str) -> str:
    """Return the algorithm of a label: ``"TDC, λ 0"`` → "TDC"."""
    return label.partition(",")[0]


def count_seeds(n: int, unfinished: int = 0) -> str:
    """Return ``"3 seeds, 1 unfinished"``."""
    text = count(n, "seed")
    return f"{text}, {unfinished} unfinished" if unfinished else text


def draw_curves(
    axes: Any,
    curves: Sequence[Curve],
    title: str,
    ylabel: str,
    log: bool = False,
    published: Sequence[PublishedCurve] = (),
) -> None:
    """
    Draw the mean over seeds with its 95 % t interval, and every seed as a thin line.

    An unfinished run is a dotted line. A published mean is a dashed line, up to the last step of our curves.

    One seed has no interval. The interval of a few seeds can be huge, and is cut off where it leaves the axis, which is
    scaled to the seeds. On a logarithmic axis, means and intervals are those of the logarithms.
    """
    if log:
        axes.set_yscale("log")
    for curve in curves:
        for run in curve.values:
            _draw_line(axes, curve.steps, run, color=curve.color, lw=0.7, alpha=0.45)
        for run in curve.unfinished:
            _draw_line(axes, curve.steps, run, ls=":", color=curve.color, lw=1.1, alpha=0.8)
        label = f"{wrap(curve.label, 44)} · {count_seeds(len(curve.values), len(curve.unfinished))}"
        values = np.log(curve.values) if log else curve.values
        mean, low, high = (np.exp(v) if log else v for v in mean_interval(values))
        _draw_line(axes, curve.steps, mean, color=curve.color, lw=1.8, label=label)
        axes.fill_between(curve.steps, low, high, color=curve.color, alpha=0.15, lw=0)
    shown = [v.ravel() for curve in curves for v in (curve.values, curve.unfinished)]
    last = max((curve.steps[-1] for curve in curves), default=0)
    for known in published:
        mean, low, high = known.interval()
        here = known.steps <= last
        label = f"{known.algorithm}, published · {count_seeds(known.seeds)}"
        axes.plot(known.steps[here], mean[here], "--", color="grey", lw=1.3, label=label)
        axes.fill_between(known.steps[here], low[here], high[here], color="grey", alpha=0.15, lw=0)
        shown.append(mean[here])
    values = np.concatenate(shown)
    _cut_intervals(axes, values[np.isfinite(values)], log)
    style_axes(axes, title, "environment steps", ylabel)
    axes.xaxis.set_major_formatter(short_number)
    add_legend(axes, "outside lower left", ncols=2)


def draw_box_plots(
    axes: Any, labels: Sequence[str], colors: Sequence[Any], returns: Sequence[np.ndarray], title: str
) -> None:
    """
    Draw one box for each algorithm, over the episodes of all its runs, and the mean of each run as a dot.

    The whiskers extend to 1.5 interquartile ranges.

    :param returns: for each algorithm, (runs, episodes)
    """
    positions = np.arange(len(labels))
    boxes = axes.boxplot(
        [r.ravel() for r in returns],
        positions=positions,
        widths=0.5,
        patch_artist=True,
        medianprops={"color": "black"},
        flierprops={"marker": ".", "markersize": 3, "alpha": 0.4},
    )
    for box, color in zip(boxes["boxes"], colors, strict=True):
        box.set(facecolor=color, alpha=0.35)
    for position, color, r in zip(positions, colors, returns, strict=True):
        axes.scatter(np.full(len(r), position), r.mean(axis=1), color=color, edgecolor="black", lw=0.6, s=22, zorder=3)
    episodes = sorted({r.shape[1] for r in returns})
    style_axes(axes, title, "", f"return of {counted(episodes, 'test episode')} a run")
    width = max(10, 60 // max(len(labels), 1))
    ticks = [f"{wrap(label, width)}\n{count_seeds(len(r))}" for label, r in zip(labels, returns, strict=True)]
    axes.set_xticks(positions, ticks, fontsize="small")
    axes.grid(visible=False, axis="x")


def draw_sweep(
    axes: Any, values: Sequence[float], returns: Sequence[np.ndarray], title: str, xlabel: str, color: Any
) -> None:
    """
    Draw returns against a hyperparameter: the mean over seeds is a diamond with its 95 % t interval, every seed a dot.

    The interval of a few seeds can be huge, and is cut off where it leaves the axis, which is scaled to the seeds.

    :param values: values of the hyperparameter, increasing
    :param returns: for each value, (runs,)
    """
    means, lows, highs = np.array([mean_interval(r) for r in returns]).T
    axes.plot(values, means, "D-", color=color, lw=1.8, ms=5)
    several = np.isfinite(lows)
    if several.any():
        x, y = np.asarray(values)[several], means[several]
        axes.errorbar(x, y, [y - lows[several], highs[several] - y], fmt="none", color=color, capsize=4, lw=1.2)
    for value, r in zip(values, returns, strict=True):
        axes.scatter(np.full(len(r), value), r, color=color, edgecolor="white", lw=0.6, s=26, zorder=3)
    _cut_intervals(axes, np.concatenate(returns))
    few, many = min(map(len, returns)), max(map(len, returns))
    seeds = count_seeds(few) if few == many else f"{few} to {count_seeds(many)}"
    style_axes(axes, title, f"{xlabel} ({seeds} each)", "final return")
    axes.set_xticks(values, [f"{value:g}" for value in values])


def draw_intervals(
    axes: Any,
    labels: Sequence[str],
    colors: Sequence[Any],
    intervals: Sequence[tuple[float, float, float]],
    title: str,
    xlabel: str,
) -> None:
    """
    Draw one row for each label: a point and its interval.

    :param intervals: point, low, high
    """
    for row, (color, (point, low, high)) in enumerate(zip(colors, intervals, strict=True)):
        axes.plot([low, high], [row, row], color=color, lw=6, alpha=0.3, solid_capstyle="butt")
        axes.plot(point, row, "o", color=color)
    style_axes(axes, title, xlabel, "")
    axes.set_yticks(range(len(labels)), ["\n".join(wrap(line, 22) for line in label.split("\n")) for label in labels])
    axes.set_ylim(len(labels) - 0.5, -0.5)


def _cut_intervals(axes: Any, values: np.ndarray, log: bool = False) -> None:
    """Limit the axis to the values and a third of their range on either side; longer intervals are cut off."""
    if not len(values):
        return
    low, high = np.log((values.min(), values.max())) if log else (values.min(), values.max())
    margin = (high - low) / 3 or 1.0
    limits = np.array([low - margin, high + margin])
    lowest, highest = np.exp(limits) if log else limits
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, lowest), min(high, highest))


def _draw_line(axes: Any, steps: np.ndarray, values: np.ndarray, **style: Any) -> None:
    """Draw a line across empty bins; a single value is a dot."""
    there = np.isfinite(values)
    marker = "o" if there.sum() == 1 else None
    axes.plot(steps[there], values[there], marker=marker, ms=4, **style)
