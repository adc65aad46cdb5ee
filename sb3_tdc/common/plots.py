"""What every plot of this package looks like."""

from typing import Any


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


def style_axes(axes: Any, title: str, xlabel: str, ylabel: str) -> None:
    """Set the texts of axes, and take away what is not needed."""
    axes.set_title(title, loc="left", fontweight="bold")
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
