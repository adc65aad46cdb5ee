"""``sb3-tdc plot RUN [RUN ...]``: learning curves of runs, from their evaluations."""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sb3_tdc.cli.arguments import Parser
from sb3_tdc.common.files import check_writable
from sb3_tdc.common.plots import add_legend, import_figure, short_number, style_axes
from sb3_tdc.common.words import counted
from sb3_tdc.runs.evaluations import read_evaluations
from sb3_tdc.runs.folder import RunFolder

_LEGEND_ROW = 0.2  # inches


@dataclass(frozen=True)
class Evaluated:
    """
    The evaluations of one run.

    :param label: algorithm and seed, and the folder if several runs share them
    :param timesteps: (evaluations,)
    :param returns: (evaluations, episodes)
    """

    label: str
    env_id: str
    timesteps: np.ndarray
    returns: np.ndarray


def load_curve(run: RunFolder, until: int | None = None) -> Evaluated:
    """
    Read the evaluations of a run.

    :param until: leave out evaluations after this step
    :raises ValueError: if the run has no evaluations, or they cannot be read
    """
    path, args, evaluations = run.evaluations, run.args, read_evaluations(run)
    if evaluations is None:
        raise ValueError(f"{path} does not exist: the run has not been evaluated yet")
    timesteps, returns = evaluations.timesteps, evaluations.returns
    shown = timesteps <= (np.inf if until is None else until)
    if not shown.any():
        raise ValueError(f"{path} has no evaluation until step {until:,}, the first is at step {timesteps[0]:,}")
    return Evaluated(f"{args['algo']}, seed {args['seed']}", args["env"], timesteps[shown], returns[shown])


def load_curves(runs: Sequence[Path], until: int | None = None) -> list[Evaluated]:
    """
    Read the evaluations of runs. Runs with the same label get the differing part of their folders added to it.

    :raises ValueError: as :func:`load_curve`, or if a folder is not a run folder
    """
    curves = [load_curve(RunFolder.open(run), until) for run in runs]
    times = Counter(curve.label for curve in curves)
    folders = [os.path.abspath(run) for run in runs]
    names = [os.path.relpath(folder, os.path.commonpath(folders)) for folder in folders]
    return [
        replace(curve, label=f"{curve.label} ({name})") if times[curve.label] > 1 else curve
        for curve, name in zip(curves, names, strict=True)
    ]


def draw_curves(axes: Any, curves: Sequence[Evaluated]) -> None:
    """
    Draw one line for each run, the mean over the episodes of each evaluation, and a dot for each episode.

    :param axes: axes of matplotlib
    :param curves: evaluations of runs on one environment
    """
    for curve in curves:
        marker = "o" if len(curve.timesteps) == 1 else None  # a line needs two points
        (line,) = axes.plot(curve.timesteps, curve.returns.mean(axis=1), label=curve.label, marker=marker)
        steps = np.repeat(curve.timesteps, curve.returns.shape[1])
        axes.scatter(steps, curve.returns.ravel(), s=9, alpha=0.45, color=line.get_color(), linewidths=0)
    numbers = sorted({curve.returns.shape[1] for curve in curves})
    style_axes(axes, curves[0].env_id, "environment steps", f"return of {counted(numbers, 'mean-action episode')}")
    axes.xaxis.set_major_formatter(short_number)
    add_legend(axes, "outside lower left", ncols=1)


def figure_size(n_curves: int) -> tuple[float, float]:
    """Return width and height in inches, with space for the legend below the axes."""
    return 7.0, 4.0 + _LEGEND_ROW * n_curves


def main(argv: Sequence[str] | None = None) -> int:
    """
    Draw the learning curves of runs.

    :param argv: arguments; by default, those of the process
    :return: 0
    """
    parser = Parser("plot", "Draw the learning curves of runs.")
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folders of runs of one environment")
    parser.add_argument("-o", "--output", type=Path, default=Path("curve.png"), help="file (.png, .svg, .pdf)")
    parser.add_argument("--until", type=int, metavar="STEP", help="leave out evaluations after this step")
    args = parser.parse_args(argv)
    try:
        curves = load_curves(args.runs, args.until)
        if len({curve.env_id for curve in curves}) > 1:
            raise ValueError("The runs must be of one environment; draw one figure for each")
        figure = import_figure()(figsize=figure_size(len(curves)), layout="constrained")
        kinds = sorted(figure.canvas.get_supported_filetypes())
        if args.output.suffix.removeprefix(".") not in kinds:
            raise ValueError(f"-o {args.output}: the name must end in one of .{', .'.join(kinds)}")
        check_writable("-o", args.output)
    except (ValueError, ImportError) as error:
        parser.fail(error)
    draw_curves(figure.subplots(), curves)
    figure.savefig(args.output, dpi=150)
    print(f"Wrote {args.output}")
    return 0
