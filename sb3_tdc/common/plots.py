"""What every plot of this package looks like."""

from typing import Any

_LINES_INSIDE = 2


def import_figure() -> Any:
    """
    Return matplotlib's class of figures.

    :raises ImportError: with the command that installs it
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('Figures need matplotlib: pip install "sb3-tdc[plot]"') from error
    return Figure


def add_legend(axes: Any, outside: str, ncols: int) -> None:
    """
    Add a legend inside the axes, or next to them where its lines would hide the curves.

    :param outside: matplotlib's location of a legend of the figure, for instance ``"outside lower left"``
    :param ncols: of columns there
    """
    handles, _ = axes.get_legend_handles_labels()
    if len(handles) <= _LINES_INSIDE:
        axes.legend(frameon=False, fontsize="small")
    else:
        axes.figure.legend(frameon=False, fontsize="small", loc=outside, ncols=ncols)


def style_axes(axes: Any, title: str, xlabel: str, ylabel: str) -> None:
    """Set the texts of axes, and take away what is not needed."""
    axes.set_title(title, loc="left", fontweight="bold")
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)


def short_number(number: float, _: int = 0) -> str:
    """Return "300k" for 300,000, and "1.5M" for 1,500,000: a formatter of an axis."""
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if abs(number) >= size:
            return f"{number / size:g}{unit}"
    return f"{number:g}"
