"""The common style of this package's plots."""

from typing import Any

_LINES_INSIDE = 2


def import_figure() -> Any:
    """
    Return matplotlib's ``Figure`` class.

    :raises ImportError: if matplotlib is not installed; the error gives the command that installs it
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('Figures need matplotlib: pip install "sb3-tdc[plot]"') from error
    return Figure


def add_legend(axes: Any, outside: str, ncols: int) -> None:
    """
    Add a legend inside the axes, or outside of them if it has so many lines that it would hide the curves.

    :param outside: matplotlib's location of the outside legend, for instance ``"outside lower left"``
    :param ncols: number of columns of the outside legend
    """
    handles, _ = axes.get_legend_handles_labels()
    if len(handles) <= _LINES_INSIDE:
        axes.legend(frameon=False, fontsize="small")
    else:
        axes.figure.legend(frameon=False, fontsize="small", loc=outside, ncols=ncols)


def style_axes(axes: Any, title: str, xlabel: str, ylabel: str) -> None:
    """Set the title and the labels of axes, hide the top and right spines, and draw a faint grid."""
    axes.set_title(title, loc="left", fontweight="bold")
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)


def short_number(number: float, _: int = 0) -> str:
    """Format a number for the ticks of an axis: "300k" for 300,000, and "1.5M" for 1,500,000."""
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if abs(number) >= size:
            return f"{number / size:g}{unit}"
    return f"{number:g}"
